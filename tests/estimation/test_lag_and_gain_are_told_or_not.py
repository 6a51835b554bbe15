"""Gain and lag of a response hold the truth within their errors, or are not stated."""

from __future__ import annotations

import numpy as np
import pytest

from greybox.estimation.lag_and_gain import LagAndGain, lag_and_gain

GAIN, LAG, DELAY = 875.0, 0.035, 0.001
"""Of a rate over a mixed command: a rotor of 35 ms and a controller's millisecond."""


def found(low: float, high: float, seed: int) -> LagAndGain | None:
    frequency = np.geomspace(low, high, 14)
    s = 2j * np.pi * frequency
    truth = GAIN * np.exp(-DELAY * s) / (s * (1.0 + LAG * s))
    error = 0.06 * np.abs(truth)
    random = np.random.default_rng(seed)
    noise = random.standard_normal((2, 14)) * error / np.sqrt(2.0)
    value = truth + noise[0] + 1j * noise[1]
    return lag_and_gain(frequency, value, error, np.ones(14, dtype=bool), 1)


@pytest.mark.parametrize("band", [(0.5, 8.0), (1.0, 12.0), (11.0, 30.0)])
def test_the_truth_is_within_three_errors_of_what_is_stated(band: tuple[float, float]) -> None:
    """Above the rotor's corner twice the gain with twice the lag looks the same."""
    stated = [f for seed in range(40) if (f := found(*band, seed)) is not None]
    assert len(stated) >= 10
    off = [
        abs(value - true) / error
        for f in stated
        for value, error, true in (
            (f.gain, f.gain_std, GAIN),
            (f.lag, f.lag_std, LAG + DELAY),
        )
    ]
    assert sum(o > 3.0 for o in off) <= 0.1 * len(off)


def test_low_frequencies_tell_both_and_high_ones_often_neither() -> None:
    assert all(found(0.5, 8.0, seed) is not None for seed in range(10))
    assert sum(found(11.0, 30.0, seed) is not None for seed in range(40)) < 30
