"""Ljung and Box's test has the values of its formula, its nominal level on white noise, and finds
an autoregression."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import scipy.stats
from scipy.signal import lfilter

from greybox.errors import DataError
from greybox.statistics.whiteness import autocorrelation, hosking, is_coloured, ljung_box
from greybox.symbolic import FloatArray

DRAWS = 1500
LEVEL = 0.05


def column(*values: float) -> list[FloatArray]:
    return [np.array(values, dtype=np.float64)[:, None]]


def test_five_numbers_by_hand():
    # 1 .. 5 about their mean: -2 -1 0 1 2, sum of squares 10; products at lag 1: 2 + 0 + 0 + 2 = 4,
    # at lag 2: 0 - 1 + 0. Q = 5 x 7 x (0.4^2 / 4 + 0.1^2 / 3), and of two degrees of freedom P =
    # exp(-Q / 2).
    test = ljung_box(autocorrelation(column(1, 2, 3, 4, 5), 2))
    q = 35 * (0.16 / 4 + 0.01 / 3)
    assert test.q == pytest.approx(q, rel=1e-14)
    assert test.p_value == pytest.approx(math.exp(-q / 2), rel=1e-12)
    assert (test.dof, test.n) == (2, 5)


def test_without_gaps_it_is_the_formula_of_the_paper():
    e = np.random.default_rng(4).standard_normal(400)
    m, c = 12, e - e.mean()
    n = len(c)
    r = [float(c[k:] @ c[:-k]) / float(c @ c) for k in range(1, m + 1)]
    q = n * (n + 2) * sum(v**2 / (n - k) for k, v in enumerate(r, start=1))
    test = ljung_box(autocorrelation([e[:, None]], m), fitted=3)
    assert test.q == pytest.approx(q, rel=1e-12)
    assert test.p_value == pytest.approx(scipy.stats.chi2.sf(q, m - 3), rel=1e-10)


def test_hosking_of_one_channel_is_ljung_and_box():
    e = np.random.default_rng(5).standard_normal((300, 1))
    e[::17] = np.nan
    joint = hosking([e[:120], e[120:]], 8)
    assert joint is not None
    assert joint.q == pytest.approx(ljung_box(autocorrelation([e[:120], e[120:]], 8)).q, rel=1e-12)


def white(rng: np.random.Generator) -> list[FloatArray]:
    return [rng.standard_normal((800, 1))]


def gappy(rng: np.random.Generator) -> list[FloatArray]:
    e = rng.standard_normal((1000, 1))
    e[rng.random(1000) < 0.3] = np.nan
    return [e]


def short_records(rng: np.random.Generator) -> list[FloatArray]:
    """Each with an offset of its own, which is no correlation where the mean of every record is
    removed."""
    return [rng.standard_normal((80, 1)) + rng.normal(0, 3) for _ in range(8)]


@pytest.mark.parametrize(
    ("make", "each"),
    [(white, False), (white, True), (gappy, False), (gappy, True), (short_records, True)],
)
def test_white_noise_is_rejected_as_often_as_the_level_says(
    make: Callable[[np.random.Generator], list[FloatArray]], each: bool
):
    rejected = sum(
        ljung_box(autocorrelation(make(np.random.default_rng([7, seed])), 20, each=each)).p_value
        < LEVEL
        for seed in range(DRAWS)
    )
    # Clopper and Pearson's exact interval; 99.9 %, as Q is chi-square only for many samples.
    interval = scipy.stats.binomtest(rejected, DRAWS).proportion_ci(
        confidence_level=0.999, method="exact"
    )
    assert interval.low < LEVEL < interval.high, rejected / DRAWS


@pytest.mark.slow
@pytest.mark.parametrize("make", [white, gappy, short_records])
def test_many_channels_are_called_coloured_no_more_often_than_one(
    make: Callable[[np.random.Generator], list[FloatArray]],
):
    draws, level = 250, 0.05
    found = 0
    for seed in range(draws):
        rng = np.random.default_rng([11, seed])
        channels = [make(rng) for _ in range(6)]
        found += is_coloured(
            [np.hstack(parts) for parts in zip(*channels, strict=True)], level=level
        )
    interval = scipy.stats.binomtest(found, draws).proportion_ci(
        confidence_level=0.999, method="exact"
    )
    assert interval.low < level < interval.high, found / draws


@pytest.mark.parametrize("phi", [0.3, -0.3])
def test_an_autoregression_is_found_in_one_channel_of_six(phi: float):
    for seed in range(20):
        rng = np.random.default_rng(seed)
        e = rng.standard_normal((1000, 6))
        e[:, 4] = lfilter([1], [1, -phi], e[:, 4])
        e[rng.random(1000) < 0.1] = np.nan
        assert is_coloured([e[:600], e[600:]])
        assert not is_coloured([np.delete(e, 4, axis=1)], level=1e-4)


def test_too_little_to_tell_is_not_called_coloured():
    ramp = np.arange(60.0)[:, None]
    assert not is_coloured([ramp])
    assert is_coloured([np.arange(200.0)[:, None]])
    assert not is_coloured([np.ones((200, 1))])
    assert not is_coloured([np.full((200, 1), np.nan)])
    assert not is_coloured([])


def test_no_degree_of_freedom_is_an_error():
    with pytest.raises(DataError, match="use more lags"):
        ljung_box(autocorrelation(column(1, 2, 3, 4, 5), 2), fitted=2)
