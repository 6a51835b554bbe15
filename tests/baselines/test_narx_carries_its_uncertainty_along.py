"""The GP on past samples: causal, honest about a free run (checked by Monte Carlo), kept in a file
bit by bit."""

from __future__ import annotations

import json

import numpy as np
import pytest

from greybox.baselines.narx import NARXModel, fit_narx
from greybox.baselines.regressors import Lags
from greybox.data import dataset_from_arrays
from greybox.errors import FileFormatError, ModelError
from greybox.files import checksum

pytest.importorskip("gpytorch")

OUTPUTS, INPUTS = ("y1", "y2"), ("u",)


def flight(seed=0, n=400, name="flight"):
    """y1 and y2 driven by u, with noise that the plant feels (a NARX system with known noise)."""
    rng = np.random.default_rng(seed)
    u = np.convolve(rng.standard_normal(n + 9), np.ones(10) / 10, "valid")
    y = np.zeros((n, 2))
    for k in range(1, n):
        y[k, 0] = 0.9 * y[k - 1, 0] + 0.1 * y[k - 1, 1] + 0.02 * rng.standard_normal()
        y[k, 1] = (
            0.8 * y[k - 1, 1]
            - 0.2 * y[k - 1, 0]
            + np.tanh(2 * u[k - 1])
            + 0.03 * rng.standard_normal()
        )
    return dataset_from_arrays(
        0.01 * np.arange(n), {"y1": y[:, 0], "y2": y[:, 1], "u": u}, name=name
    )


@pytest.fixture(scope="module")
def trained():
    return fit_narx(flight(0), outputs=OUTPUTS, inputs=INPUTS, n_a=2, n_b=2, points=40, seed=1)


def test_its_one_step_intervals_cover_new_data_and_its_noise_is_the_plants(trained):
    segment = flight(5, n=1500).segments[0]
    mean, variance = trained.one_step(segment)
    known = np.isfinite(mean).all(axis=1)
    assert known.sum() == segment.n - 2
    z = (segment.matrix(OUTPUTS) - mean)[known] / np.sqrt(variance[known])
    assert np.mean(np.abs(z) < 1.96, axis=0) == pytest.approx([0.95, 0.95], abs=0.03)
    assert np.sqrt(trained.posterior.noise) == pytest.approx([0.02, 0.03], rel=0.2)


def test_the_spread_of_a_free_run_is_that_of_simulated_futures(trained):
    """Monte Carlo of the same recursion: every step draws from the GP's predictive distribution."""
    segment = flight(6).segments[0]
    horizon, runs = 15, 4000
    mean, variance = trained.free_run(segment, [100], horizon)
    past, moved = trained.lags.starts(segment, [100], horizon)
    rng = np.random.default_rng(0)
    many = np.repeat(past, runs, axis=0)
    drawn = np.empty((runs, horizon, 2))
    for h in range(horizon):
        m, v = trained.posterior.evaluate(
            Lags.joined(many, np.repeat(moved[:, h], runs, axis=0)), noise=True
        )
        drawn[:, h] = m + np.sqrt(v) * rng.standard_normal(m.shape)
        many = trained.lags.pushed(many, drawn[:, h])
    assert variance[0] == pytest.approx(drawn.var(axis=0), rel=0.15)
    assert mean[0] == pytest.approx(drawn.mean(axis=0), abs=0.02)


def test_the_first_step_of_a_free_run_is_the_one_step_prediction(trained):
    segment = flight(2).segments[0]
    origins = np.array([10, 50, segment.n - 1, segment.n - 3])
    one = trained.one_step(segment)
    mean, variance = trained.free_run(segment, origins, 4)
    inside = origins + 1 < segment.n
    assert mean[inside, 0] == pytest.approx(one[0][origins[inside] + 1], abs=1e-10)
    assert variance[inside, 0] == pytest.approx(one[1][origins[inside] + 1], rel=1e-9)
    assert np.isfinite(mean[2, 0]).all() and np.isnan(mean[2, 1:]).all(), (
        "one sample past the end is known"
    )


@pytest.mark.parametrize("increments", [False, True])
def test_neither_the_measurement_nor_the_command_of_an_instant_moves_its_prediction(increments):
    model = fit_narx(
        flight(0), outputs=OUTPUTS, inputs=INPUTS, n_a=2, n_b=2, increments=increments, points=20
    )
    segment = flight(2).segments[0]
    now = np.arange(segment.n) == 100
    moved = segment.replace(
        {n: np.where(now, 5.0, segment.channels[n]) for n in (*OUTPUTS, *INPUTS)}
    )
    before, after = model.one_step(segment)[0], model.one_step(moved)[0]
    assert np.array_equal(after[:101], before[:101], equal_nan=True)
    assert not np.array_equal(after[101], before[101])


def test_increments_and_values_predict_alike_on_data_that_move_slowly(trained):
    segment = flight(2).segments[0]
    other = fit_narx(
        flight(0), outputs=OUTPUTS, inputs=INPUTS, n_a=2, n_b=2, increments=True, points=40
    )
    a, b = trained.one_step(segment)[0][2:], other.one_step(segment)[0][2:]
    assert np.sqrt(np.mean((a - b) ** 2)) < 0.02
    far, variance = other.free_run(segment, [100], 10)
    assert np.isfinite(far).all() and np.all(np.diff(variance[0, :5, 0]) > 0)


def test_it_survives_the_file_bit_by_bit_and_a_changed_file_is_refused(trained, tmp_path):
    path = trained.save(tmp_path / "narx.json")
    again = NARXModel.load(path)
    segment = flight(2).segments[0]
    assert np.array_equal(again.one_step(segment)[1], trained.one_step(segment)[1], equal_nan=True)
    assert again.parameters == trained.parameters
    body = json.loads(path.read_text())
    body["increments"] = not body["increments"]
    path.write_text(json.dumps(body))
    with pytest.raises(FileFormatError, match="checksum"):
        NARXModel.load(path)


@pytest.mark.parametrize("wrong", [{"train_seconds": "long"}, {"lags": []}, {"posterior": 1.0}])
def test_a_file_that_fits_its_checksum_and_nothing_else_is_refused(trained, tmp_path, wrong):
    """Whoever made the file made its checksum, too."""
    path = trained.save(tmp_path / "narx.json")
    body = json.loads(path.read_text()) | wrong
    del body["checksum"]
    path.write_text(json.dumps(body | {"checksum": checksum(body)}))
    with pytest.raises(FileFormatError, match="incomplete or wrong"):
        NARXModel.load(path)


def test_a_gp_over_other_inputs_is_refused(trained):
    with pytest.raises(ModelError, match="lags"):
        NARXModel(
            lags=Lags(outputs=OUTPUTS, inputs=INPUTS, n_a=3, n_b=2),
            increments=False,
            posterior=trained.posterior,
        )
