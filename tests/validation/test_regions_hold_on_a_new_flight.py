"""Regions for a flight that was not seen: as wide as the differences between the seen flights ask
for, no wider."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.stats

from greybox.validation.new_flight import GRID, new_flight_factor

LIMIT = scipy.stats.norm.ppf(0.975)


def shares(errors):
    """Share of errors (n, N) inside the regions of a standard normal times exp(GRID)."""
    return np.array([[np.mean(np.abs(e) <= LIMIT * f) for f in np.exp(GRID)] for e in errors])


def flights(rng, count, spread, samples=400):
    scale = np.exp(spread * rng.standard_normal(count))[:, None]
    return scale * rng.standard_normal((count, samples))


@pytest.mark.parametrize(("count", "spread"), [(5, 0.3), (10, 0.3), (10, 0.15), (8, 0.0)])
def test_the_share_expected_of_a_new_flight_is_what_was_asked_for(count, spread):
    """Over many sets of flights the mean coverage on the next flight is 95 %; with a pooled level
    it is less."""
    rng = np.random.default_rng(count)
    covered, pooled = [], []
    for _ in range(120):
        seen, new = flights(rng, count, spread, 200), flights(rng, 20, spread, 200)
        level = np.sqrt(np.mean(seen**2))
        factor = new_flight_factor(shares(seen / level))
        covered.append(np.mean(np.abs(new) <= LIMIT * level * factor))
        pooled.append(np.mean(np.abs(new) <= LIMIT * level))
    assert np.mean(covered) == pytest.approx(0.955, abs=0.015)
    if spread >= 0.3:
        assert np.mean(pooled) < np.mean(covered) - 0.01


def test_heavy_tails_widen_regions_too():
    rng = np.random.default_rng(0)
    errors = rng.standard_t(3, (10, 2000))
    errors /= 1.2 * np.median(np.abs(errors))
    factor = new_flight_factor(shares(errors))
    assert np.mean(np.abs(errors) <= LIMIT * factor) == pytest.approx(0.95, abs=0.01)


def test_regions_never_shrink_and_few_flights_say_nothing():
    rng = np.random.default_rng(0)
    assert new_flight_factor(shares(0.3 * flights(rng, 6, 0.0))) == 1.0
    assert new_flight_factor(shares(3.0 * flights(rng, 2, 0.0))) == 1.0
    assert new_flight_factor(shares(1e3 * flights(rng, 6, 0.0))) == pytest.approx(4.0)
