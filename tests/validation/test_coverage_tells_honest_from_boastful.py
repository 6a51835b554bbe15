"""Coverage is nominal for calibrated errors, low for overconfident ones, and its interval knows
correlation."""

import numpy as np
import pytest
from scipy.signal import lfilter

from greybox.errors import DataError
from greybox.validation.bootstrap import block_bootstrap
from greybox.validation.coverage import (
    binomial_interval,
    coverage_of_distances,
    interval_coverage,
    mahalanobis_squared,
)


@pytest.mark.parametrize("nominal", [0.68, 0.95])
def test_calibrated_gaussian_is_honest_and_overconfidence_is_not(nominal: float) -> None:
    rng = np.random.default_rng(3)
    flights = [0.3 * rng.standard_normal(2000) for _ in range(3)]
    good = interval_coverage(flights, 0.3, nominal=nominal)
    assert good.n == 6000
    assert good.honest
    assert good.fraction == pytest.approx(nominal, abs=0.02)
    bad = interval_coverage(flights, 0.2, nominal=nominal)
    assert not bad.honest
    assert bad.fraction < nominal


def test_vector_coverage_uses_the_whole_covariance() -> None:
    rng = np.random.default_rng(4)
    root = np.array([[1.0, 0, 0], [0.9, 0.2, 0], [0, 0.5, 0.3]])
    errors = rng.standard_normal((5000, 3)) @ root.T
    distance = mahalanobis_squared(errors, root @ root.T)
    assert distance.mean() == pytest.approx(3.0, abs=0.12)
    assert coverage_of_distances([distance], dimension=3).honest
    shape = np.diag(np.diag(root @ root.T))
    assert mahalanobis_squared(np.array([[np.nan, 0, 0], [1.0, 0, 0]]), shape)[1] == pytest.approx(
        1.0
    )
    assert np.isnan(mahalanobis_squared(np.array([[np.nan, 0, 0]]), shape)[0])


def test_missing_errors_are_counted() -> None:
    result = interval_coverage([np.array([0.1, np.nan, 5.0])], 1.0)
    assert (result.n, result.missing, result.fraction) == (2, 1, 0.5)
    infinite = interval_coverage([np.array([0.1, np.inf])], 1.0)
    assert (infinite.n, infinite.fraction) == (2, 0.5)


def test_clopper_pearson_reference_values() -> None:
    # The classic table: 0 of 10 -> upper 0.3085; 5 of 10 -> 0.1871 .. 0.8129.
    assert binomial_interval(0, 10).high == pytest.approx(0.3085, abs=1e-4)
    both = binomial_interval(5, 10)
    assert (both.low, both.high) == (
        pytest.approx(0.1871, abs=1e-4),
        pytest.approx(0.8129, abs=1e-4),
    )


def test_bad_uncertainties_are_refused() -> None:
    with pytest.raises(DataError, match="positive definite"):
        mahalanobis_squared(np.ones((2, 2)), np.zeros((2, 2)))
    with pytest.raises(DataError, match="not positive"):
        interval_coverage([np.ones(3)], [np.array([1.0, 0.0, 1.0])])
    with pytest.raises(DataError, match="no sample"):
        interval_coverage([np.array([np.nan])], 1.0)


def test_block_bootstrap_covers_the_mean_of_correlated_flights_where_samples_do_not() -> None:
    rng = np.random.default_rng(5)
    trials, inside, naive = 60, 0, 0
    for seed in range(trials):
        flights = [
            0.3 * rng.standard_normal() + lfilter([1], [1, -0.9], rng.standard_normal(400))
            for _ in range(8)
        ]
        interval = block_bootstrap(flights, block=40, draws=200, seed=seed)
        everything = np.concatenate(flights)
        inside += interval.low <= 0.0 <= interval.high
        naive += abs(everything.mean()) <= 1.96 * everything.std() / np.sqrt(len(everything))
    assert inside >= 0.87 * trials
    assert naive < 0.6 * trials


def test_block_bootstrap_checks_its_arguments() -> None:
    with pytest.raises(DataError, match="block"):
        block_bootstrap([np.ones(4)], block=0)
    with pytest.raises(DataError, match="no sample"):
        block_bootstrap([np.full(4, np.nan)], block=2)
