"""Thinning a curve keeps its extremes and its gaps; numbers are rounded to what their spread
allows."""

import matplotlib
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from greybox.report import figures
from greybox.report.decimate import min_max
from greybox.report.svg import to_svg
from greybox.report.words import interval, number, p_value, rounded, strong_correlations


@given(st.integers(1, 3000), st.integers(1, 50), st.integers(0, 1000))
def test_extremes_and_ends_survive(n: int, buckets: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    t, y = np.arange(n) * 0.01, rng.standard_normal(n)
    x, v = min_max(t, y, buckets=buckets)
    assert v.max() == y.max()
    assert v.min() == y.min()
    assert (x[0], x[-1]) == (t[0], t[-1])
    assert len(x) <= 2 * buckets + 2
    assert np.all(np.diff(x) > 0)
    # every point that is drawn was measured
    np.testing.assert_array_equal(y[np.rint(x / 0.01).astype(int)], v)


def test_every_bucket_keeps_its_peak() -> None:
    t = np.arange(10_000) * 0.01
    y = np.zeros(10_000)
    y[[123, 4567, 9876]] = [5.0, -7.0, 3.0]
    _, v = min_max(t, y, buckets=100)
    assert {5.0, -7.0, 3.0} <= set(v.tolist())


@pytest.mark.parametrize("buckets", [5, 1000])
def test_missing_samples_and_gaps_break_the_line(buckets: int) -> None:
    t = np.concatenate([np.arange(100), np.arange(300, 400)]) * 0.01
    y = np.sin(t)
    y[20:25] = np.nan
    x, v = min_max(t, y, buckets=buckets)
    assert np.isnan(v).sum() == np.isnan(x).sum() == 2
    assert min_max(t, np.full(200, np.nan))[0].size == 0


def test_rounding_follows_the_spread() -> None:
    assert rounded(0.0427312, 0.00113) == ("0.0427", "0.0011")
    assert rounded(-1234.5, 321.0) == ("−1230", "320")
    assert rounded(1.8312e-5, 4.1e-7) == ("1.831e−5", "4.1e−7")
    assert rounded(0.5, None)[1] == "–"
    assert interval(1.0, 0.1) == "0.80 .. 1.20"
    assert interval(1.0, None) == "–"
    assert number(float("nan")) == "–"
    assert number(1e-5) == "1e−5"
    assert p_value(1e-9) == "< 0.0001"


def test_strong_correlations_are_said_in_words() -> None:
    lines = strong_correlations(["a", "b", "c"], [[1, 0.95, 0], [0.95, 1, -0.99], [0, -0.99, 1]])
    assert len(lines) == 2
    assert lines[0].startswith("b and c")
    assert "sum" in lines[0]
    assert "difference" in lines[1]


def test_drawing_leaves_matplotlib_as_it_was() -> None:
    before = dict(matplotlib.rcParams)
    figure = figures.correlogram([1, 2], [0.1, 0.5], 0.2, title="p")
    first = to_svg(figure, name="a", label="x")
    assert dict(matplotlib.rcParams) == before
    assert first == to_svg(
        figures.correlogram([1, 2], [0.1, 0.5], 0.2, title="p"), name="a", label="x"
    )
    assert "var(--ink)" in first
    assert "#0b" not in first
