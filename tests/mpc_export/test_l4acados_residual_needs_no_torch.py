"""The learned residual in l4acados's shape: exact, with slopes and variance, from a bundle, without
PyTorch."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from mpc_export.exported import load
from mpc_export.l4acados import LearnedResidual, nominal
from tests.mpc_export import consumers


@functools.cache
def parts():
    model = load(consumers.bundle("hybrid"))
    return model, LearnedResidual(model)


def horizon(model, n: int = 7) -> np.ndarray:
    rng = np.random.default_rng(3)
    rows = []
    for _ in range(n):
        x = model["boxplus"](
            model.reference_state, 0.1 * rng.standard_normal(len(model.error_states))
        )
        rows.append(np.concatenate([x.full().ravel(), rng.uniform(0.2, 0.8, len(model.inputs))]))
    return np.array(rows)


def test_shapes_are_those_that_l4acados_reads():
    model, learned = parts()
    y = horizon(model)
    n_w, width = len(learned.rows), len(model.states) + len(model.inputs)
    value, slope = learned.value_and_jacobian(y)
    assert learned.B.shape == (len(model.states), n_w)
    assert value.shape == (7, n_w) == learned.current_variance.shape
    assert slope.shape == (n_w, 7, width)
    np.testing.assert_array_equal(learned.current_prediction, value)
    np.testing.assert_array_equal(learned.current_mean, value)
    np.testing.assert_array_equal(learned.current_prediction_dy, slope)
    np.testing.assert_array_equal(learned.evaluate(y[:2]), value[:2])
    np.testing.assert_array_equal(learned.jacobian(y[2:3]), slope[:, 2:3])


def test_nominal_step_plus_residual_is_the_hybrid_step():
    model, learned = parts()
    y, n = horizon(model), len(model.states)
    value = learned.evaluate(y)
    plain = nominal(model)
    for row, r in zip(y, value):
        whole = model["f_d"](row[:n], row[n:], model.parameter_values).full().ravel()
        alone = plain["f_d"](row[:n], row[n:], model.parameter_values).full().ravel()
        assert np.abs(whole - alone).max() > 1e-4, "the case should have something learned"
        np.testing.assert_allclose(alone + learned.B @ r, whole, atol=1e-14)


def test_slopes_are_those_of_central_differences():
    model, learned = parts()
    y, step = horizon(model, 3), 1e-6
    slope = learned.jacobian(y)
    for i in range(y.shape[1]):
        move = step * np.eye(y.shape[1])[i]
        numeric = (learned.evaluate(y + move) - learned.evaluate(y - move)) / (2 * step)
        np.testing.assert_allclose(slope[:, :, i].T, numeric, atol=1e-7)


def test_the_variance_is_the_spread_of_the_next_state():
    model, learned = parts()
    y, n = horizon(model, 3), len(model.states)
    learned.evaluate(y)
    for row, variance in zip(y, learned.current_variance):
        x, u, p = row[:n], row[n:], model.parameter_values
        push = model["B_d_raw"](x, u, p).full()
        own = model["gp_variance"](model["gp_features_raw"](x, u, p)[0], p).full().ravel()
        expected = np.diag(push @ np.diag(own) @ push.T)
        np.testing.assert_allclose(learned.B @ variance, expected, rtol=1e-10, atol=1e-18)
        assert variance.max() > 0


def test_its_loop_finds_the_solution_of_the_whole_hybrid_model_without_torch():
    got = consumers.run("hybrid", "l4acados_hover.py")  # there is no torch where this runs
    assert got["last"] < 1e-6
    assert got["difference"] < 1e-4


def test_a_model_without_a_learned_part_is_refused():
    with pytest.raises(ValueError, match="lacks f_d_nominal"):
        LearnedResidual(load(consumers.bundle("physics")))


def test_points_of_another_width_are_refused():
    _, learned = parts()
    with pytest.raises(ValueError, match="expected y of shape"):
        learned.evaluate(np.zeros((3, 5)))
