"""The temporal convolution predicts causally, is trained on the free run that it is judged by, and
beats its start."""

from __future__ import annotations

import numpy as np
import pytest

from greybox.data import dataset_from_arrays
from greybox.errors import DataError

torch = pytest.importorskip("torch")

STEPS = 8


def flight(seed: int, n: int = 500):
    """p turns by u, ax follows p late; both with a little noise."""
    rng = np.random.default_rng(seed)
    u = np.convolve(rng.standard_normal(n + 9), np.ones(10) / 10, "valid")
    y = np.zeros((n, 2))
    for k in range(1, n):
        y[k] = 0.9 * y[k - 1, 0] + 0.5 * u[k - 1], 0.8 * y[k - 1, 1] + 0.3 * y[k - 1, 0]
    y += 0.01 * rng.standard_normal(y.shape)
    return dataset_from_arrays(0.01 * np.arange(n), {"p": y[:, 0], "ax": y[:, 1], "u1": u}).segments


def trained(increments: bool = True, **more):
    from greybox.baselines.tcn import TCNSettings, train_tcn

    settings = TCNSettings(
        levels=2,
        channels=8,
        unroll=5,
        increments=increments,
        learning_rate=1e-2,
        **{"epochs": 15, **more},
    )
    return train_tcn(
        flight(0), flight(1), outputs=("p", "ax"), inputs=("u1",), settings=settings, seed=3
    )


@pytest.fixture(scope="module")
def model():
    return trained()


def error_ahead(model, steps: int) -> float:
    """RMSE of the free run on a flight that training has not seen."""
    (segment,) = flight(2)
    origins = np.arange(20, segment.n - steps - 1, 5)
    mean, _ = model.free_run(segment, origins, steps)
    truth = segment.matrix(model.outputs)[origins + steps]
    return float(np.sqrt(np.mean((mean[:, -1] - truth) ** 2)))


def test_ahead_it_is_nearer_than_the_last_value(model):
    (segment,) = flight(2)
    y = segment.matrix(model.outputs)
    still = float(np.sqrt(np.mean((y[20 + STEPS :] - y[20:-STEPS]) ** 2)))
    assert error_ahead(model, STEPS) < 0.35 * still


@pytest.mark.parametrize("increments", [False, True])
def test_the_unrolled_network_of_training_is_the_free_run_that_is_judged(increments):
    from greybox.baselines.tcn import _single, _windows

    model, (segment,) = trained(increments, epochs=1), flight(2)
    x, _ = _windows([segment], model.lags, STEPS, 1, model.middle, model.scale)
    with torch.no_grad():
        unrolled = (
            model.network(_single(x)).numpy().reshape(len(x), STEPS, 2) * model.scale[:2]
            + model.middle[:2]
        )
    origins = np.arange(model.lags.history - 1, segment.n - STEPS)
    np.testing.assert_allclose(unrolled, model.free_run(segment, origins, STEPS)[0], atol=1e-5)


def test_it_sees_no_measurement_and_no_command_of_its_instant(model):
    (segment,), at = flight(2), 100
    moved = {
        n: np.where(np.arange(segment.n) == at, v + 0.3, v) for n, v in segment.channels.items()
    }
    before, after = model.one_step(segment)[0], model.one_step(segment.replace(moved))[0]
    assert np.array_equal(before[: at + 1], after[: at + 1], equal_nan=True)
    window = model.lags.history
    assert not np.isclose(before[at + 1 : at + 1 + window], after[at + 1 : at + 1 + window]).any()
    assert np.array_equal(before[at + 1 + window :], after[at + 1 + window :], equal_nan=True)


def test_rotation_and_translation_are_networks_of_their_own(model):
    """What translation has learned is none of rotation's business: weights are not shared."""
    assert model.network.parts == [[0], [1]]
    (segment,) = flight(2)
    before = model.one_step(segment)[0]
    weight = model.network.branches[1].head.bias
    with torch.no_grad():
        weight += 1.0
        after = model.one_step(segment)[0]
        weight -= 1.0
    assert np.array_equal(before[:, 0], after[:, 0], equal_nan=True)
    assert (np.abs(before - after)[20:, 1] > 0.01).all()


def test_stretches_that_are_too_short_are_one_line():
    from greybox.baselines.tcn import TCNSettings, train_tcn

    (segment,) = flight(0, n=12)
    with pytest.raises(DataError, match="no stretch is long enough"):
        train_tcn([segment], [segment], outputs=("p", "ax"), inputs=("u1",), settings=TCNSettings())
