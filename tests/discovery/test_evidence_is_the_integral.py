"""Evidence by Laplace is the integral of likelihood times prior: exact for a linear model, and
along one side at a bound."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.integrate
import scipy.stats

from tests.discovery.linear_world import NUISANCES, SIGMA, World, drawn


def test_it_is_exact_for_a_linear_gaussian_model():
    """Against the density of y, the shared coefficients having a flat prior: Lebesgue measure."""
    world, _ = drawn(1, {"a": np.array([0.7])})
    columns = np.column_stack([world.columns["a"], world.columns["c"]])
    cov = np.eye(len(world.y)) + SIGMA**2 * columns @ columns.T
    inverse = np.linalg.inv(cov)
    x = world.shared
    inner = x.T @ inverse @ x
    b = np.linalg.solve(inner, x.T @ inverse @ world.y)
    off = world.y - x @ b
    exact = -0.5 * float(off @ inverse @ off) - 0.5 * np.linalg.slogdet(2 * np.pi * cov)[1]
    exact += 0.5 * NUISANCES * np.log(2 * np.pi) - 0.5 * np.linalg.slogdet(inner)[1]
    assert world.fit({"a", "c"}).log_evidence == pytest.approx(exact, abs=1e-5)


@pytest.mark.parametrize("size", [-1.0, 0.0, 2.0])
def test_a_parameter_that_may_not_be_negative_is_integrated_over_what_it_may_be(size: float):
    rng = np.random.default_rng(0)
    x = rng.standard_normal((40, 1))
    y = size * x[:, 0] + rng.standard_normal(40)
    world = World(columns={"a": x}, shared=np.zeros((40, 0)), y=y, lower=0.0)

    def density(t: float) -> float:
        logs = scipy.stats.norm.logpdf(y - t * x[:, 0]).sum() - best
        return float(np.exp(logs) * 2 * scipy.stats.norm.pdf(t, scale=SIGMA))

    best = -world.fit({"a"}).value.likelihood
    integral, _ = scipy.integrate.quad(density, 0.0, 10.0, points=[0.1, 0.5, 1, 2, 3])
    assert world.fit({"a"}).log_evidence == pytest.approx(best + np.log(integral), abs=0.05)
