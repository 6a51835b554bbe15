"""Smooth inputs and coloured innovations do not fake a dependence; a real one is found, feedback is
not one."""

import numpy as np
import pytest
from scipy.signal import lfilter

from greybox.errors import DataError
from greybox.validation.cross_correlation import cross_correlation


def _ar(rng, phi: float, n: int = 3000) -> np.ndarray:
    return lfilter([1], [1, -phi], rng.standard_normal(n))


@pytest.mark.parametrize(("phi_e", "phi_u"), [(0.0, 0.95), (0.7, 0.95), (0.9, 0.9)])
def test_independent_coloured_signals_stay_inside(phi_e: float, phi_u: float) -> None:
    draws, outside, naive, rejected = 100, 0.0, 0.0, 0
    for seed in range(draws):
        rng = np.random.default_rng(seed)
        e, u = _ar(rng, phi_e), _ar(rng, phi_u)
        pair = cross_correlation([e[:1000], e[1000:]], [u[:1000], u[1000:]]).pairs[0]
        outside += pair.outside / draws
        naive += np.mean(np.abs(pair.r[26:]) > 2.576 / np.sqrt(pair.n)) / draws
        rejected += pair.p_value < 0.01
    assert outside < 0.03
    assert rejected <= 4
    if phi_e:
        assert naive > 0.1


def test_missed_dynamics_are_found_at_the_right_lag() -> None:
    rng = np.random.default_rng(0)
    u = _ar(rng, 0.5)
    e = 0.2 * np.roll(u, 3) + rng.standard_normal(len(u))
    e[:3] = 0.0
    e[500:520] = np.nan
    result = cross_correlation(e, u, names=["p"], input_names=["u1"])
    pair = result.pairs[0]
    assert pair.p_value < 1e-6
    assert int(np.argmax(pair.r)) - result.max_lag == 3


def test_feedback_alone_raises_no_alarm_but_is_visible_at_negative_lags() -> None:
    rejected = 0
    for seed in range(60):
        e = np.random.default_rng(seed).standard_normal(3000)
        u = lfilter([0.0, 0.5], [1, -0.8], e) + 0.3 * np.random.default_rng(
            seed + 999
        ).standard_normal(3000)
        pair = cross_correlation(e, u).pairs[0]
        rejected += pair.p_value < 0.01
        assert abs(pair.r[24]) > pair.band
    assert rejected <= 3
    assert "positive lags" in cross_correlation(e, u).note


def test_an_input_that_never_moves_is_named_and_skipped() -> None:
    rng = np.random.default_rng(0)
    u = np.stack([rng.standard_normal(500), np.full(500, 0.5)], axis=1)
    result = cross_correlation(rng.standard_normal(500), u, input_names=["u1", "u2"])
    assert result.skipped == ("u2",)
    assert "u2" in result.format()
    with pytest.raises(DataError, match="no input moves"):
        cross_correlation(rng.standard_normal(500), np.ones(500))
    with pytest.raises(DataError, match="length"):
        cross_correlation(rng.standard_normal(500), np.ones(400))
