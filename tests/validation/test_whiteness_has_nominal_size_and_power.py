"""The whiteness tests alarm as often as they say on white noise, and always on an
autoregression."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from greybox.errors import DataError
from greybox.statistics.whiteness import PERIODOGRAM_POINTS, cumulated_periodogram
from greybox.validation.whiteness import whiteness

DRAWS = 200


def _rejections(make) -> tuple[float, float]:
    single, joint = 0.0, 0
    for seed in range(DRAWS):
        result = whiteness(make(np.random.default_rng(seed)), max_lag=20)
        single += np.mean([c.test.p_value < 0.05 for c in result.channels])
        joint += result.multivariate.p_value < 0.05
    return single / DRAWS, joint / DRAWS


def _white(rng):
    e = rng.standard_normal((1200, 3)) @ np.array([[1, 0.5, 0], [0, 1, 0.7], [0, 0, 1.0]])
    return [e[:500], e[500:]]


def _gappy(rng):
    e = rng.standard_normal((1500, 3))
    e[rng.random(len(e)) < 0.3] = np.nan
    return e


@pytest.mark.parametrize("make", [_white, _gappy])
def test_false_alarms_are_nominal(make) -> None:
    single, joint = _rejections(make)
    # 600 single tests (binomial std 0.9 %) and 200 joint ones (1.5 %)
    assert 0.02 < single < 0.085
    assert 0.005 < joint < 0.11


def test_an_autoregression_is_found_and_sized() -> None:
    rng = np.random.default_rng(0)
    e = lfilter([1], [1, -0.5], rng.standard_normal(4000))
    result = whiteness(e, names=["p"])
    channel = result.channels[0]
    assert channel.test.p_value < 1e-10
    assert channel.r[0] == pytest.approx(0.5, abs=0.05)
    # an AR(1) explains phi^2 of its own variance
    assert channel.predictable == pytest.approx(0.25, abs=0.04)
    assert result.multivariate is None


def test_gaps_do_not_fake_correlation_and_lags_do_not_cross_flights() -> None:
    a, b = np.zeros(60), np.zeros(60)
    a[-1], b[0], a[0] = 50.0, 50.0, 1.0
    apart = whiteness([a, b], max_lag=5).channels[0]
    together = whiteness([np.concatenate([a, b])], max_lag=5).channels[0]
    assert abs(apart.r[0]) < 0.05
    assert together.r[0] > 0.4


def test_cross_dependence_between_channels_shows_only_in_the_joint_test() -> None:
    rng = np.random.default_rng(2)
    a = rng.standard_normal(3000)
    b = 0.3 * np.roll(a, 1) + rng.standard_normal(3000)
    result = whiteness(np.stack([a, b], axis=1)[1:], max_lag=10)
    assert min(c.test.p_value for c in result.channels) > 0.01
    assert result.multivariate.p_value < 1e-10


def test_degrees_of_freedom_are_corrected_for_fitted_parameters() -> None:
    # Residuals of a fitted AR(2): without the correction the test alarms too seldom.
    small = [[], []]
    for seed in range(DRAWS):
        rng = np.random.default_rng(seed)
        y = lfilter([1], [1, -0.6, 0.2], rng.standard_normal(600))
        x = np.stack([y[1:-1], y[:-2]], axis=1)
        e = y[2:] - x @ np.linalg.lstsq(x, y[2:], rcond=None)[0]
        for i, fitted in enumerate((0, 2)):
            small[i].append(whiteness(e, max_lag=6, fitted=fitted).channels[0].test.p_value)
    plain, corrected = (np.mean(np.array(p) < 0.05) for p in small)
    assert plain < 0.035
    assert 0.02 < corrected < 0.09


@given(st.integers(0, 10_000), st.floats(1e-6, 1e6))
@settings(max_examples=20, deadline=None)
def test_units_do_not_matter(seed: int, scale: float) -> None:
    e = np.random.default_rng(seed).standard_normal((300, 2))
    a, b = whiteness(e, max_lag=8), whiteness(scale * e, max_lag=8)
    assert b.multivariate.q == pytest.approx(a.multivariate.q, rel=1e-6)
    np.testing.assert_allclose(b.channels[0].r, a.channels[0].r, rtol=1e-6, atol=1e-12)


def test_bad_input() -> None:
    rng = np.random.default_rng(0)
    with pytest.raises(DataError, match="too few"):
        whiteness(rng.standard_normal(20), max_lag=10)
    with pytest.raises(DataError, match="constant"):
        whiteness(np.ones(100), max_lag=5)
    with pytest.raises(DataError, match="use more lags"):
        whiteness(rng.standard_normal(100), max_lag=5, fitted=5)
    with pytest.raises(DataError, match="copies"):
        whiteness(np.repeat(rng.standard_normal((200, 1)), 2, axis=1), max_lag=5)


def test_text_names_every_channel() -> None:
    text = whiteness(
        np.random.default_rng(0).standard_normal((300, 2)), names=["p", "q"], max_lag=5
    ).format()
    assert "p" in text
    assert "all channels together" in text


def left_the_band(make: Callable[[np.random.Generator], np.ndarray], runs: int) -> float:
    """Share of records of which the cumulated periodogram leaves the band of white noise."""
    line = np.linspace(0.0, 1.0, PERIODOGRAM_POINTS)
    out = 0
    for k in range(runs):
        share, band = cumulated_periodogram([make(np.random.default_rng(k))[:, None]])
        out += bool(np.any(np.abs(share - line) > band))
    return out / runs


@pytest.mark.parametrize("missing", [0.0, 0.2])
def test_a_cumulated_periodogram_of_white_noise_stays_in_its_band(missing: float) -> None:
    def white(rng: np.random.Generator) -> np.ndarray:
        return np.where(rng.random(600) < missing, np.nan, 3.0 + rng.standard_normal(600))

    # The band is that of the whole curve, of which 51 points are looked at: at most 5 %.
    assert 0.005 < left_the_band(white, 600) < 0.06


def test_a_cumulated_periodogram_shows_where_the_power_is() -> None:
    assert (
        left_the_band(lambda rng: lfilter([1.0], [1.0, -0.3], rng.standard_normal(600)), 100) > 0.95
    )
    share, _ = cumulated_periodogram([np.sin(2 * np.pi * 0.1 * np.arange(1000))[:, None]])
    grid = np.linspace(0.0, 0.5, PERIODOGRAM_POINTS)
    assert share[grid < 0.095].max() < 0.01
    assert share[grid > 0.105].min() > 0.99
    both = [
        np.random.default_rng(1).standard_normal((400, 1)),
        np.random.default_rng(2).standard_normal((101, 1)),
    ]
    assert cumulated_periodogram(both)[0][-1] == pytest.approx(1.0)
    assert cumulated_periodogram([np.ones((50, 1))]) == (
        pytest.approx(np.zeros(PERIODOGRAM_POINTS)),
        np.inf,
    )
