"""Claim: whichever solver, the same optimum: estimates within a thousandth of a standard error,
cost within 1e-6."""

from __future__ import annotations

import functools
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from greybox.estimation.criteria.gaussian import Gaussian
from greybox.estimation.criteria.least_squares import LeastSquares
from greybox.estimation.initialisation import equation_error, noise_start
from greybox.estimation.predictors.innovation import Innovation
from greybox.estimation.predictors.simulation import Simulation
from greybox.estimation.problem import Problem, make_problem
from greybox.estimation.solvers import SOLVERS
from greybox.estimation.solvers.levenberg_marquardt import (
    BEYOND,
    LevenbergMarquardt,
    boxed_step,
    hopeless,
    promise_of,
)
from greybox.estimation.status import Code
from greybox.symbolic import FloatArray
from tests import motor
from tests.simulated import flights, vehicle

FAST = [n for n in SOLVERS if n != "ipopt-exact"]


def precise(name: str) -> Any:
    return SOLVERS[name](tolerance=1e-10)


@functools.cache
def motor_problem(kind: str) -> tuple[Problem, FloatArray, FloatArray]:
    """(problem, start, optimum by Levenberg-Marquardt)."""
    predictor, criterion = (
        (Innovation(), Gaussian()) if kind == "innovation" else (Simulation(), LeastSquares())
    )
    data = motor.record(torque_noise=0.002 if kind == "innovation" else 0.0)
    problem = make_problem(motor.model(), data, predictor=predictor, criterion=criterion)
    start = noise_start(problem, equation_error(problem))
    return (
        problem,
        start,
        LevenbergMarquardt(tolerance=1e-12, max_iterations=200).solve(problem, start)[0],
    )


@functools.cache
def quadrotor_problem(kind: str) -> tuple[Problem, FloatArray, FloatArray]:
    from greybox import build_model

    data = flights(count=1, seconds=4.0)
    model = build_model(
        vehicle(), data.channels, ("motor_lag", "command_delay", "rotor_drag", "rotational_damping")
    )
    if kind == "innovation":
        problem = make_problem(model, data, predictor=Innovation(), criterion=Gaussian())
    else:
        short = data.split_by_time(at=float(data.segments[0].t[0]) + 2.0)[0]
        problem = make_problem(model, short, predictor=Simulation(), criterion=LeastSquares())
    start = noise_start(problem, equation_error(problem))
    return (
        problem,
        start,
        LevenbergMarquardt(tolerance=1e-12, max_iterations=200).solve(problem, start)[0],
    )


def same(problem: Problem, theta: FloatArray, best: FloatArray) -> None:
    value, other = problem.evaluate(best), problem.evaluate(theta, 0)
    assert value.hessian is not None
    error = np.sqrt(np.diag(np.linalg.inv(value.hessian)))
    assert other.cost == pytest.approx(value.cost, abs=1e-6)
    assert (np.abs(theta - best) / error).max() < 1e-3


@pytest.mark.parametrize("kind", ["innovation", "simulation"])
@pytest.mark.parametrize("name", SOLVERS)
def test_on_the_motor(name: str, kind: str) -> None:
    problem, start, best = motor_problem(kind)
    theta, status = precise(name).solve(problem, start)
    assert status.converged, status.advice
    same(problem, theta, best)


@pytest.mark.parametrize("kind", ["innovation", "simulation"])
@pytest.mark.parametrize("name", FAST)
def test_on_the_quadrotor(name: str, kind: str) -> None:
    problem, start, best = quadrotor_problem(kind)
    theta, status = precise(name).solve(problem, start)
    assert status.converged, status.advice
    same(problem, theta, best)


@pytest.mark.parametrize("name", SOLVERS)
def test_an_active_bound_is_reached_exactly(name: str) -> None:
    problem = make_problem(
        motor.model(), motor.record(), predictor=Simulation(), criterion=Gaussian()
    )
    i = problem.place("J")
    assert i is not None
    unknowns = list(problem.unknowns)
    unknowns[i] = replace(unknowns[i], lower=2.2e-4)
    bounded = replace(problem, unknowns=tuple(unknowns))
    start = equation_error(bounded)
    best, _ = LevenbergMarquardt(tolerance=1e-12, max_iterations=200).solve(bounded, start)
    theta, status = precise(name).solve(bounded, start)
    assert status.converged, status.advice
    assert theta[i] == 2.2e-4
    assert bounded.evaluate(theta, 0).cost == pytest.approx(
        bounded.evaluate(best, 0).cost, abs=1e-4
    )


@pytest.mark.parametrize("name", FAST)
def test_one_iteration_is_not_called_converged(name: str) -> None:
    problem, _, _ = motor_problem("simulation")
    theta, status = SOLVERS[name](max_iterations=1).solve(problem, problem.start)
    assert not status.converged
    assert status.advice.startswith("NOT converged")
    assert theta.shape == (problem.n,)


@pytest.mark.parametrize("name", ["levenberg-marquardt", "gauss-newton"])
@pytest.mark.parametrize(("factor", "steps"), [(0.02, 12), (0.1, 12), (10.0, 20), (50.0, 25)])
def test_noise_levels_may_start_far_off(factor: float, steps: int, name: str) -> None:
    # Steps in the logarithms of the levels take 38 from below: each of them overshoots.
    for problem, _, best in (motor_problem("innovation"), quadrotor_problem("innovation")):
        level = np.array([u.kind == "noise" for u in problem.unknowns])
        theta, status = SOLVERS[name]().solve(problem, best + np.where(level, np.log(factor), 0.0))
        assert status.converged
        assert status.iterations <= steps
        assert problem.evaluate(theta, 0).cost == pytest.approx(
            problem.evaluate(best, 0).cost, abs=1e-5
        )


class Creeping:
    """cost x^2/2 with a Hessian that is fifty times too large: every step takes two per cent of the
    way."""

    lower, upper = np.array([-9.0]), np.array([9.0])
    unknowns = (SimpleNamespace(kind="parameter", origin=np.nan),)

    def evaluate(self, x, order=2):
        cost = 1e3 + 0.5 * float(x @ x)
        return SimpleNamespace(
            cost=cost, likelihood=cost, valid=True, gradient=x.copy(), hessian=np.array([[50.0]])
        )


def test_a_search_ends_where_it_cannot_catch_up() -> None:
    """Far above the target it stops as soon as its pace is known; a target that it reaches changes
    nothing."""
    problem, start, best = quadrotor_problem("innovation")
    cost = problem.evaluate(best, 0).likelihood
    _, lost = LevenbergMarquardt(target=cost - 1e4).solve(problem, start)
    assert lost.code is Code.BEHIND
    assert not lost.converged
    plain, status = LevenbergMarquardt().solve(problem, start)
    aimed, other = LevenbergMarquardt(target=cost + 1.0).solve(problem, start)
    assert status.converged
    assert other == status
    np.testing.assert_array_equal(plain, aimed)


def test_the_pace_is_that_of_the_last_iterations() -> None:
    falling = [1000.0, 900.0, 800.0, 700.0, 600.0, 500.0]
    assert not hopeless(falling, 1e4, target=-500.0, left=5)  # twice 100 an iteration
    assert hopeless(falling, 1e4, target=-501.0, left=5)
    assert not hopeless(falling[:-1], 1e4, target=-1e9, left=1)
    assert hopeless([5.0, *[1.0] * 6], 1e4, target=0.9, left=50)
    assert not hopeless([5.0, *[1.0] * 6], 1e4, target=np.inf, left=50)


def test_an_optimum_is_not_much_deeper_than_the_full_step_promises() -> None:
    falling = [1000.0, 900.0, 800.0, 700.0, 600.0, 500.0]
    assert not hopeless(falling, 50.0, target=501.0 - BEYOND * 50.0, left=50)
    assert hopeless(falling, 50.0, target=499.0 - BEYOND * 50.0, left=50)
    assert not hopeless(
        falling[:-1], 0.0, target=-1e9, left=50
    )  # the first steps promise too little


@pytest.mark.parametrize(("start", "arrived"), [(0.3, True), (4.0, False)])
def test_a_search_that_runs_out_has_arrived_where_little_is_promised(
    start: float, arrived: bool
) -> None:
    solver = LevenbergMarquardt(damped=False, max_iterations=1)
    _, status = solver.solve(Creeping(), np.array([start]))  # type: ignore[arg-type]
    assert status.converged is arrived
    assert (status.decrement < 1e-3) is arrived


def test_a_hessian_that_is_fifty_times_too_large_is_learned() -> None:
    """Steps of Gauss-Newton alone would creep: 0.98 of the way is left after each."""
    theta, status = LevenbergMarquardt().solve(Creeping(), np.array([4.0]))  # type: ignore[arg-type]
    assert status.converged
    assert status.iterations < 8
    assert abs(theta[0]) < 1e-3


@pytest.mark.parametrize("name", SOLVERS)
def test_a_start_without_a_finite_cost_is_said(name: str) -> None:
    problem, _, _ = motor_problem("simulation")
    bad = problem.start.copy()
    bad[0] = np.nan
    _, status = SOLVERS[name]().solve(problem, bad)
    assert status.code is Code.INVALID_START


@pytest.mark.parametrize("count", [100, pytest.param(400, marks=pytest.mark.slow)])
def test_a_step_in_a_box_is_the_best_one_however_many_bounds_it_meets(count: int) -> None:
    """By the conditions of Karush, Kuhn and Tucker, in units of each unknown's own curvature. A
    set of bounds that goes round in circles had ended at a step that promises a rise, which was
    taken for an optimum."""
    random = np.random.default_rng(0)
    for _ in range(count):
        n = int(random.integers(2, 50))
        root = random.standard_normal((n + 3, n)) * 10 ** random.uniform(-3, 3, n)
        root += random.standard_normal((n + 3, 1)) @ random.standard_normal((1, n)) * 1e2
        h = root.T @ root + 1e-6 * np.eye(n)
        g = random.standard_normal(n) * 10 ** random.uniform(-3, 5, n)
        low, high = -(10 ** random.uniform(-3, 2, n)), 10 ** random.uniform(-3, 2, n)
        low[random.random(n) < 0.1] = 0.0
        step = boxed_step(g, h, low, high, 0.0)
        assert (low <= step).all() and (step <= high).all()
        assert promise_of(g, h, step) >= 0.0
        unit = np.sqrt(np.diag(h))
        slope = (g + h @ step) / unit
        moved = np.clip(step * unit - slope, low * unit, high * unit)
        assert np.abs(moved - step * unit).max() < 1e-6 * max(1.0, np.abs(g / unit).max())
