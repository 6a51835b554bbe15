"""Regret against brute force: of Gaussian likelihoods the second order is all there is."""

from __future__ import annotations

import numpy as np
import pytest

from greybox.statistics.regret import information_on, regret


@pytest.mark.parametrize("seed", range(5))
def test_regret_is_the_supremum_less_the_integral(seed: int):
    random = np.random.default_rng(seed)
    a, b = random.standard_normal((2, 6, 3))
    v1, new = a.T @ a, b.T @ b
    theta1, best = random.standard_normal((2, 3))
    v = v1 + new
    theta = np.linalg.solve(v, v1 @ theta1 + new @ best)
    # Under N(theta1, v1^-1) the integral of exp(-(x - best)' new (x - best) / 2); its supremum is 1.
    spread = np.linalg.inv(v1) + np.linalg.inv(new)
    log_integral = 0.5 * (
        np.linalg.slogdet(np.linalg.inv(new))[1]
        - np.linalg.slogdet(spread)[1]
        - (theta1 - best) @ np.linalg.solve(spread, theta1 - best)
    )
    assert regret(v, theta, v1, theta1) == pytest.approx(-log_integral, rel=1e-9)


def test_data_that_say_nothing_new_cost_nothing():
    v = np.diag([2.0, 3.0])
    assert regret(v, np.ones(2), v, np.ones(2)) == 0.0


def test_information_on_some_is_that_of_their_own_covariance():
    random = np.random.default_rng(0)
    a = random.standard_normal((9, 5)) * np.array([1, 1e3, 1, 1e-4, 1])
    h = a.T @ a
    own = information_on(h, [0, 3], [1, 2, 4])
    wanted = np.linalg.inv(np.linalg.inv(h)[np.ix_([0, 3], [0, 3])])
    np.testing.assert_allclose(own, wanted, rtol=1e-6)
