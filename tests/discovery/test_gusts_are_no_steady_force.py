"""The mean of the gusts of a flight belongs to the gusts: a steady force of every flight gains
nothing beside them."""

from __future__ import annotations

from greybox.estimation.criteria.gaussian import Gaussian
from greybox.estimation.laplace import log_evidence
from greybox.estimation.predictors.innovation import Innovation
from greybox.estimation.problem import make_problem
from greybox.estimation.solvers.levenberg_marquardt import LevenbergMarquardt
from tests import gusty

RIDES = 12


def gained(**world: float) -> float:
    """Log evidence per ride of a steady force of its own, level and time of the gusts free in both
    structures."""
    found = []
    for steady in (["b"], []):
        problem = make_problem(
            gusty.model(),
            gusty.rides(RIDES, **world),
            predictor=Innovation(),
            criterion=Gaussian(),
            free=[*steady, "disturbance.v.T"],
            noise=gusty.LEVELS,
            build=["b"],
        )
        theta, status = LevenbergMarquardt().solve(problem, problem.start)
        assert status.converged
        found.append(log_evidence(problem, theta, problem.evaluate(theta)))
    return (found[0] - found[1]) / RIDES


def test_a_force_that_is_the_mean_of_the_gusts_costs_evidence():
    """Gusts that last as long as a ride have a mean there and start at any size: both are
    theirs."""
    assert gained() < -0.5


def test_a_force_in_still_air_is_found_beside_gusts_that_could_last():
    assert gained(push=gusty.SIGMA, sigma=0.0) > 1.0
