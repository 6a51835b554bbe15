"""Scores of Gaussian predictions equal their definitions, and know calibrated from boastful."""

import numpy as np
import pytest
import scipy.integrate
import scipy.stats

from greybox.errors import DataError
from greybox.validation.predictive import coverage, crps, gaussian_nlpd, nlpd, pit, score, sharpness


def test_crps_is_the_integral_of_the_squared_cdf_difference():
    y, m, s = 0.7, 0.2, 0.4
    below = scipy.integrate.quad(lambda x: scipy.stats.norm.cdf(x, m, s) ** 2, -5, y)[0]
    above = scipy.integrate.quad(lambda x: (1 - scipy.stats.norm.cdf(x, m, s)) ** 2, y, 5)[0]
    assert crps([y], [m], [s * s]) == pytest.approx(below + above, rel=1e-7)


def test_nlpd_is_the_log_density():
    y, m, v = np.array([0.1, 2.0]), np.array([0.0, 1.0]), np.array([0.5, 2.0])
    assert nlpd(y, m, v) == pytest.approx(-scipy.stats.norm.logpdf(y, m, np.sqrt(v)).mean())


def test_vector_density_agrees_with_scipy():
    rng = np.random.default_rng(0)
    a = rng.standard_normal((4, 3, 3))
    c = a @ a.transpose(0, 2, 1) + np.eye(3)
    e = rng.standard_normal((4, 3))
    expected = [-scipy.stats.multivariate_normal.logpdf(e[i], cov=c[i]) for i in range(4)]
    assert gaussian_nlpd(e, c) == pytest.approx(expected)


def test_a_calibrated_prediction_scores_best_and_has_a_flat_pit():
    rng = np.random.default_rng(1)
    y = rng.standard_normal(20_000)
    honest = score(y, np.zeros_like(y), np.ones_like(y))
    assert honest.coverage[0.95] == pytest.approx(0.95, abs=0.006)
    assert honest.coverage[0.50] == pytest.approx(0.50, abs=0.012)
    assert honest.pit == pytest.approx(np.full(20, 0.05), abs=0.008)
    for factor in (0.25, 4.0):
        other = score(y, np.zeros_like(y), factor * np.ones_like(y))
        assert other.nlpd > honest.nlpd
        assert other.crps > honest.crps
    assert coverage(y, 0.0, 0.25, 0.95) < 0.7
    assert sharpness(y, 0.0, 0.25) == pytest.approx(0.5)
    assert pit(y, 0.0, 0.25)[0] > 0.1


def test_missing_samples_are_left_out_and_bad_variances_refused():
    assert nlpd([0.0, np.nan], [0.0, 5.0], [1.0, 1.0]) == pytest.approx(0.5 * np.log(2 * np.pi))
    with pytest.raises(DataError, match="variance"):
        nlpd([0.0], [0.0], [0.0])
    with pytest.raises(DataError, match="no measured sample"):
        nlpd([np.nan], [0.0], [1.0])
