"""A push that comes at once is learned at once and begins no rival; noise of any size is no push."""

import functools

import numpy as np
import pytest

from mpc_export.functions import model_functions
from mpc_export.tube.restless import Restless
from mpc_export.tube.rival import Known, Rival, likelier
from tests.mpc_export import cases
from tests.mpc_export.tube.test_controller_flies_and_survives import pilot as settled
from tests.mpc_export.tube.test_plans_use_what_the_filter_learns import pilot as adaptive

FORCE, TORQUE = 0.0277, 0.0015
"""A tenth of the weight [N], two elevenths of the torque that rotors hold against [N m]."""


@functools.cache
def of_the_craft():
    functions = model_functions(cases.disturbed(), with_=("filter",))
    names = functions.error_states.names
    at = [names.index(f"d_disturbance.{kind}.{a}") for kind in ("force", "torque") for a in "xyz"]
    return functions, at, Restless(functions, at)


def watched(size, samples, seed=0):
    """(Steps, what is more) of every sample (samples, 6) under white innovations `size` times as
    large as stated."""
    functions, _, restless = of_the_craft()
    root = np.linalg.cholesky(functions.noise.innovation)
    rng, sums, steps, more = np.random.default_rng(seed), restless.start(), [], []
    for _ in range(samples):
        e = size * root @ rng.standard_normal(len(root))
        steps.append(restless.sees(restless.start(), e)[0])
        sums = restless.sees(sums, e)
        more.append((sums[0] ** 2 - sums[1], restless.more(sums)))
    return np.array(steps), *(np.array(v) for v in zip(*more, strict=True))


@pytest.mark.parametrize("size", [1.0, 10.0])
def test_white_innovations_of_any_size_ask_for_nothing_in_the_mean(size):
    steps, signed, more = watched(size, 4000)
    np.testing.assert_allclose(steps.std(axis=0), size, rtol=0.05)
    spread = (signed / size**2).std(axis=0)
    assert (np.abs((signed / size**2).mean(axis=0)) < 0.15 * spread).all()
    assert (more >= 0.0).all()


def test_one_step_asks_for_nothing_and_steps_one_way_for_more_each():
    functions, at, restless = of_the_craft()
    e = functions.noise.gain[at[4]] * functions.noise.innovation.diagonal()
    step = restless.sees(restless.start(), e)[0][4]
    assert step > 0.0
    sums, found = restless.start(), []
    for _ in range(10):
        sums = restless.sees(sums, e)
        found.append(restless.more(sums)[4])
    assert found[0] == 0.0
    assert (np.diff(found) > 0.0).all()
    assert found[-1] > step**2


def flight(controller, steps, *, force=0.0, torque=0.0, noise=None, seed=0):
    """The model as the plant, pushed from sample 60 on, sensors `noise` (n_y,) times as noisy as
    stated: (places, commands, (force, torque) believed) of every sample."""
    f = controller.filter
    names, rng = f.states.names, np.random.default_rng(seed)
    rows = [names.index("disturbance.force.x"), names.index("disturbance.torque.y")]
    groups = controller.model.dynamics.innovation_columns
    stated = np.array(
        [
            min(s for s, own in zip(f.noise.sensor, groups, strict=True) if column in own)
            for column in f.outputs.names
        ]
    )
    controller.start()
    x, u, out = controller.estimate.copy(), controller.u, []
    for k in range(steps):
        x[rows] = np.array([force, torque]) * (k >= 60)
        y = f["h"](x, u, f.parameter_values).full().ravel()
        y += (0.0 if noise is None else noise) * stated * rng.standard_normal(len(y))
        new = np.array(controller.sample(0.01 * k, dict(zip(f.outputs.names, y.tolist()))))
        x, u = f["f_d"](x, u, f.parameter_values).full().ravel(), new
        out.append((x[:3], new, controller.estimate[rows]))
    return tuple(np.array(v) for v in zip(*out, strict=True))


def test_a_push_that_makes_the_estimate_late_begins_no_rival():
    controller = settled()
    path, *_ = flight(controller, 120, force=FORCE, torque=TORQUE, noise=1.0)
    found = {e.what for e in controller.events}
    assert any(what.startswith("doubted") for what in found)
    assert "the filter starts anew" not in found
    assert 0.1 < np.linalg.norm(path - [0.0, 0.0, 1.0], axis=1).max() < 0.3


@pytest.mark.slow
def test_a_push_that_denies_the_estimate_throws_the_craft_less_far_than_without_rivals(monkeypatch):
    controller, farthest = settled(), []
    for speaks in (likelier, lambda *_: Rival()):
        monkeypatch.setattr("mpc_export.tube.estimator.likelier", speaks)
        away, begun = [], 0
        for seed in range(6):
            path, *_ = flight(controller, 200, force=FORCE, torque=0.0022, noise=1.0, seed=seed)
            away.append(np.linalg.norm(path - [0.0, 0.0, 1.0], axis=1).max())
            begun += sum(e.what == "the filter starts anew" for e in controller.events)
        farthest.append(np.mean(away))
        assert (begun > 0) == (speaks is likelier)
    assert farthest[0] < farthest[1]


@pytest.mark.slow
def test_a_torque_and_a_force_that_come_at_once_are_learned_within_samples(monkeypatch):
    controller, left = adaptive(), []
    for walk in (controller.estimator.restless.more, lambda sums: np.zeros(sums.shape[1])):
        monkeypatch.setattr(controller.estimator.restless, "more", walk)
        _, _, believed = flight(controller, 80, force=FORCE, torque=TORQUE)
        left.append(np.abs(believed[65:] / [FORCE, TORQUE] - 1.0).mean(axis=0))
    assert (left[0] < 0.5 * left[1]).all()


@pytest.mark.slow
def test_a_gyro_four_times_as_noisy_as_stated_makes_commands_no_rougher(monkeypatch):
    controller, rough = adaptive(), []
    noise = np.array([4.0 if n in "pqr" else 1.0 for n in controller.filter.outputs.names])
    for walk in (controller.estimator.restless.more, lambda sums: np.zeros(sums.shape[1])):
        monkeypatch.setattr(controller.estimator.restless, "more", walk)
        _, commands, _ = flight(controller, 300, noise=noise)
        rough.append(np.abs(np.diff(commands[100:], axis=0)).mean())
    assert rough[0] < 1.05 * rough[1]


@pytest.mark.slow
def test_an_estimate_that_takes_over_is_no_surer_of_a_push_than_before_or_at_a_start():
    controller = adaptive()
    controller.start()
    own, pushes = controller.filter.adapted, controller.estimator._pushes
    assert [own.names[at] for at in pushes][3:] == [f"error.disturbance.torque.{a}" for a in "xyz"]
    n = len(own.rows)
    root = np.random.default_rng(0).standard_normal((len(own.names),) * 2)
    before = Known(
        controller.estimate, controller.p[list(own.rows)], root @ root.T, np.ones((2, len(pushes)))
    )
    y = controller.filter["h"](controller.estimate, controller.u, controller.p).full().ravel()
    begun = [
        controller.estimator._measured(
            before, y, np.ones(len(controller.filter.innovations.names)), pushed
        )
        for pushed in (True, False)
    ]
    for known, kept in zip(begun, (before.unsure, np.zeros_like(root)), strict=True):
        more = known.unsure - own.covariance
        np.testing.assert_allclose(more[np.ix_(pushes, pushes)], kept[np.ix_(pushes, pushes)])
        np.testing.assert_array_equal(known.unsure[:n, :n], before.unsure[:n, :n])
        assert not known.unsure[:n, n:].any() and not known.steps.any()
        assert np.linalg.eigvalsh(known.unsure).min() > -1e-12
