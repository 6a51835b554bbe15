"""A risk per flight becomes standard deviations: by Boole's inequality, by passages, by rehearsed
flights."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import norm

from greybox.errors import ModelError
from mpc_export.tube.risk import kappa, kappa_passages, kappa_rehearsed, passages


@given(st.floats(1e-6, 0.5), st.integers(1, 5000))
def test_parts_add_up(level, pairs):
    each = norm.sf(kappa(level, pairs))
    assert pairs * each == pytest.approx(level, rel=1e-6)


@pytest.mark.parametrize(("level", "pairs"), [(0.0, 3), (1.0, 3), (0.1, 0), (0.1, float("nan"))])
def test_nonsense_is_refused(level, pairs):
    with pytest.raises(ModelError):
        kappa(level, pairs)


def test_a_passage_ends_where_a_limit_is_left_for_long():
    rows = np.zeros((40, 2), dtype=bool)
    rows[3:8, 0] = rows[10:12, 0] = rows[30:33, 0] = rows[39, 1] = True
    assert passages(rows, gap=2) == [9, 3, 1]
    assert passages(rows, gap=1) == [5, 2, 3, 1]
    assert passages(np.zeros((5, 3), dtype=bool)) == []


def test_stages_that_fail_together_count_once_and_independent_ones_as_boole_says():
    together, apart = np.ones((8, 8)), np.eye(8)
    one = kappa_passages(0.1, [8, 8], together)
    assert one == pytest.approx(kappa(0.1, 2), abs=0.03)
    assert kappa_passages(0.1, [8, 8], apart) == pytest.approx(kappa(0.1, 16), abs=0.03)
    half = kappa_passages(0.1, [8, 8], 0.5 * together + 0.5 * apart)
    assert one < half < kappa(0.1, 16)
    # passages of twenty flights are those of one, and a long one is several
    assert kappa_passages(0.1, [8, 8] * 20, apart, flights=20) == pytest.approx(
        kappa(0.1, 16), abs=0.03
    )
    assert kappa_passages(0.1, [16], apart) == kappa_passages(0.1, [8, 8], apart)


def test_a_risk_that_needs_no_backoff_gets_none():
    assert kappa_passages(0.6, [1], np.eye(1)) == 0.0
    with pytest.raises(ModelError):
        kappa_passages(0.1, [], np.eye(1))


def test_rehearsals_find_the_backoff_of_a_known_loop_from_the_safe_side():
    rng = np.random.default_rng(0)
    tried, flights = [0.5, 1.0, 1.5, 2.0], [60] * 4
    rates = norm.cdf(0.8 - 1.2 * np.array(tried))
    draws = rng.binomial(60, rates, size=(25, 4))
    found = np.array(
        [[kappa_rehearsed(v, tried, hits, flights) for v in (0.2, 0.1, 0.05)] for hits in draws]
    )
    assert (np.diff(found, axis=1) > 0).all()
    for level, column in zip((0.2, 0.1, 0.05), found.T, strict=True):
        real = norm.cdf(0.8 - 1.2 * column)
        assert 0.6 < np.mean(real <= level) < 1.0  # surety 0.8
        assert np.median(real) > 0.4 * level  # and not for the price of everything


def test_rehearsals_that_never_fail_or_always_do():
    assert kappa_rehearsed(0.2, [1.0, 2.0], [0, 0], [50, 50]) <= 1.0
    with pytest.raises(ModelError):
        kappa_rehearsed(0.05, [0.1, 0.2], [50, 50], [50, 50])
    with pytest.raises(ModelError):
        kappa_rehearsed(0.05, [1.0, 1.0], [2, 2], [50, 50])
