"""Claims: on a quadratic cost the profile interval is the symmetric one; what data do not identify
has no end."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

import greybox as gb
from greybox.data import dataset_from_arrays
from greybox.errors import UnknownNameError
from greybox.estimation.criteria.gaussian import Gaussian
from greybox.estimation.criteria.least_squares import LeastSquares
from greybox.estimation.fit import fit
from greybox.estimation.predictors.simulation import Simulation
from greybox.estimation.problem import Problem, make_problem
from greybox.estimation.profile import profile
from greybox.estimation.solvers import SOLVERS
from greybox.estimation.solvers.levenberg_marquardt import LevenbergMarquardt
from greybox.model.dynamics import StateSpaceModel
from greybox.model.parameter import Parameter
from greybox.symbolic import FloatArray, Layout, Signal
from tests import motor


def straight(product: bool = False) -> StateSpaceModel:
    """y = slope * u + level (or a * b * u), which is linear in its parameters."""
    names = ("a", "b") if product else ("slope", "level")
    return StateSpaceModel(
        name="line",
        states=Layout([Signal(name="x", unit="1")]),
        inputs=Layout([Signal(name="u", unit="1")]),
        outputs=Layout([Signal(name="y", unit="1")]),
        parameters=tuple(Parameter(name=n, unit="1", nominal=1.0) for n in names),
        dynamics=lambda t, x, u, p: [x[0]],
        measurement=lambda t, x, u, p: [
            p["a"] * p["b"] * u if product else p["slope"] * u + p["level"]
        ],
        discrete=True,
        sensor_sigma={"y": 0.1},
    )


def line(product: bool = False) -> Problem:
    """The straight line with white noise."""
    rng = np.random.default_rng(2)
    u = np.linspace(-1, 1, 200)
    y = 2.0 * u + 0.5 * (not product) + 0.1 * rng.standard_normal(200)
    data = dataset_from_arrays(0.01 * np.arange(200), {"u": u, "y": y})
    return make_problem(
        straight(product),
        data,
        predictor=Simulation(),
        criterion=LeastSquares(),
        estimate_initial=False,
    )


def optimum(problem: Problem) -> FloatArray:
    return LevenbergMarquardt(tolerance=1e-12).solve(problem, problem.start)[0]


@pytest.mark.parametrize("solver", ["levenberg-marquardt", "gauss-newton", "scipy-trf"])
def test_on_a_linear_model_the_interval_is_two_standard_errors(solver: str) -> None:
    problem = line()
    theta = optimum(problem)
    hessian = problem.evaluate(theta).hessian
    assert hessian is not None
    error = np.sqrt(np.linalg.inv(hessian)[0, 0])
    found = profile(problem, SOLVERS[solver](), theta, "slope", level=0.95)
    assert found.converged.all()
    assert found.upper - found.estimate == pytest.approx(1.95996 * error, rel=1e-3)
    assert found.estimate - found.lower == pytest.approx(1.95996 * error, rel=1e-3)
    rise = found.cost - found.cost.min()
    np.testing.assert_allclose(rise, 0.5 * ((found.grid - found.estimate) / error) ** 2, atol=1e-6)


def test_where_errors_are_coloured_the_interval_holds_what_the_error_bar_does() -> None:
    rng, n = np.random.default_rng(4), 4000
    u, drive = np.sin(0.02 * np.arange(n)), 0.1 * rng.standard_normal(n)
    noise = lfilter([np.sqrt(1 - 0.9**2)], [1.0, -0.9], drive)
    data = dataset_from_arrays(0.01 * np.arange(n), {"u": u, "y": 2.0 * u + 0.5 + noise})
    found = fit(
        straight(), data, predictor="simulation", criterion="least-squares", estimate_initial=False
    )
    slope = found.parameters["slope"]
    assert found.coloured and slope.std > 3 * slope.std_fisher
    interval = gb.profile(found, "slope")
    assert interval.upper - interval.estimate == pytest.approx(1.95996 * slope.std, rel=1e-2)
    assert interval.estimate - interval.lower == pytest.approx(1.95996 * slope.std, rel=1e-2)
    assert interval.lower < 2.0 < interval.upper


def test_a_factor_of_a_product_has_no_interval() -> None:
    problem = line(product=True)
    found = profile(
        problem, LevenbergMarquardt(), optimum(problem), "a", grid=[0.5, 0.8, 1.5, 3.0, 6.0]
    )
    assert found.upper == np.inf
    assert found.lower == -np.inf
    assert np.ptp(found.cost) < 1e-6


def test_the_motors_profile_ends_where_the_likelihood_has_fallen_by_the_quantile() -> None:
    problem = make_problem(
        motor.model(), motor.record(n=300), predictor=Simulation(), criterion=Gaussian()
    )
    theta = optimum(problem)
    found = profile(problem, LevenbergMarquardt(), theta, "b", level=0.68)
    again = profile(problem, LevenbergMarquardt(), theta, "b", grid=[found.lower, found.upper])
    np.testing.assert_allclose(again.cost[[0, -1]] - again.cost[1], 0.5 * 0.98894, rtol=0.02)


def test_an_unknown_that_is_none_is_named() -> None:
    problem = line()
    with pytest.raises(UnknownNameError, match="slop"):
        profile(problem, LevenbergMarquardt(), problem.start, "slop")
