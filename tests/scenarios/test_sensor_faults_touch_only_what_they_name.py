"""Sensor faults have the stated size, touch only the named columns and never change the log they
are given."""

from __future__ import annotations

import numpy as np
import pytest

from scenarios.plants import sensor_faults as faults


@pytest.fixture
def log():
    t = 0.01 * np.arange(5000)
    return {"t": t, "p": np.sin(t), "ax": np.cos(t), "omega1": np.full(t.size, 1700.0)}


CASES = {
    "coloured_noise": lambda log, rng: faults.coloured_noise(log, ["p"], 0.1, 0.2, rng),
    "drifting_bias": lambda log, rng: faults.drifting_bias(log, ["p"], 0.1, rng),
    "quantised": lambda log, rng: faults.quantised(log, ["p"], 0.1),
    "delayed": lambda log, rng: faults.delayed(log, ["p"], 0.015),
    "low_passed": lambda log, rng: faults.low_passed(log, ["p"], 5.0),
    "vibration": lambda log, rng: faults.vibration(log, ["p"], 0.1, rng),
}


@pytest.mark.parametrize("name", CASES)
def test_only_the_named_column_changes(log, name):
    before = {k: v.copy() for k, v in log.items()}
    out = CASES[name](log, np.random.default_rng(0))
    assert all(np.array_equal(log[k], before[k]) for k in log)
    assert all(np.array_equal(out[k], log[k]) for k in ("t", "ax", "omega1"))
    assert not np.array_equal(out["p"], log["p"], equal_nan=True)


def test_coloured_noise_has_its_variance_and_correlation(log):
    many = {"t": log["t"], "p": np.zeros((5000, 40))}
    noise = faults.coloured_noise(many, ["p"], 0.3, 0.1, np.random.default_rng(1))["p"]
    assert np.std(noise) == pytest.approx(0.3, rel=0.03)
    assert np.mean(noise[10:] * noise[:-10]) / 0.09 == pytest.approx(np.exp(-1.0), abs=0.03)


def test_delay_is_exact_between_samples(log):
    late = faults.delayed(log, ["p"], 0.015)["p"]
    assert late[10:] == pytest.approx(np.sin(log["t"][10:] - 0.015), abs=2e-5)


def test_dropped_rows_leave_the_others_aligned(log):
    out = faults.dropped_rows(log, 0.2, np.random.default_rng(2))
    assert 3800 < out["t"].size < 4200
    assert np.array_equal(out["p"], np.sin(out["t"]))
