"""Claims about predictors: exact gradients, limit cases (textbook filter, stationary gain, one
step), one optimum."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import pytest

from greybox.data import Dataset, dataset_from_arrays
from greybox.errors import FitError
from greybox.estimation.criteria.gaussian import Gaussian
from greybox.estimation.engine import Windows
from greybox.estimation.initialisation import equation_error
from greybox.estimation.predictors import PREDICTORS
from greybox.estimation.predictors.innovation import Innovation
from greybox.estimation.predictors.k_step import KStep
from greybox.estimation.predictors.kalman import Kalman
from greybox.estimation.predictors.multiple_shooting import MultipleShooting
from greybox.estimation.predictors.simulation import Simulation
from greybox.estimation.problem import Problem, make_problem
from greybox.estimation.solvers.levenberg_marquardt import LevenbergMarquardt
from greybox.model.dynamics import StateSpaceModel
from greybox.model.parameter import Parameter
from greybox.symbolic import FloatArray, Layout, Signal
from tests import motor
from tests.differences import gradient_error


def with_gaps(data: Dataset) -> Dataset:
    """Every third speed and a stretch of currents missing."""
    s = data.segments[0]
    c = {k: np.array(v) for k, v in s.channels.items()}
    c["speed"][::3] = np.nan
    c["current"][50:70] = np.nan
    return dataset_from_arrays(s.t, c)


@pytest.mark.parametrize("name", PREDICTORS)
def test_the_gradient_is_that_of_the_cost(name: str) -> None:
    data = with_gaps(motor.record(n=200, torque_noise=0.002))
    problem = make_problem(motor.model(), data, predictor=PREDICTORS[name](), criterion=Gaussian())
    assert gradient_error(problem, equation_error(problem)) < 1e-6


@pytest.mark.parametrize("name", PREDICTORS)
def test_compiled_code_and_virtual_machine_give_the_same_numbers(name: str) -> None:
    data = with_gaps(motor.record(n=100, torque_noise=0.002))
    values = [
        make_problem(
            motor.model(),
            data,
            predictor=PREDICTORS[name](),
            criterion=Gaussian(),
            use_compiler=compiled,
        )
        for compiled in (True, False)
    ]
    one, two = (p.evaluate(p.start) for p in values)
    assert one.cost == pytest.approx(two.cost, rel=1e-10)
    np.testing.assert_allclose(
        one.gradient, two.gradient, rtol=1e-5, atol=1e-6 * np.abs(two.gradient).max()
    )


# ---------------------------------------------------------------------------------- Kalman filter


def linear_model() -> StateSpaceModel:
    """Two states, one output that sees both, one parameter."""

    def f(t: Any, x: Any, u: Any, p: Any) -> list[Any]:
        return [p["a"] * x[0] + 0.2 * x[1] + u, 0.8 * x[1] - 0.1 * x[0]]

    return StateSpaceModel(
        name="linear",
        states=Layout([Signal(name="x1", unit="1"), Signal(name="x2", unit="1")]),
        inputs=Layout([Signal(name="u", unit="1")]),
        outputs=Layout([Signal(name="y", unit="1"), Signal(name="z", unit="1")]),
        parameters=(Parameter(name="a", unit="1", nominal=0.9),),
        dynamics=f,
        measurement=lambda t, x, u, p: [x[0] + 0.5 * x[1], x[1] - 0.3 * x[0]],
        discrete=True,
        initial_sigma={"x1": 2.0, "x2": 0.7},
        sensor_sigma={"y": 0.3, "z": 0.5},
    )


def linear_data(n: int = 300) -> Dataset:
    rng = np.random.default_rng(5)
    x, rows = np.zeros(2), []
    u = rng.standard_normal(n)
    for k in range(n):
        y = np.array([[1, 0.5], [-0.3, 1]]) @ x + np.array([0.3, 0.5]) * rng.standard_normal(2)
        rows.append(y)
        x = (
            np.array([[0.9, 0.2], [-0.1, 0.8]]) @ x
            + np.array([u[k], 0.0])
            + 0.1 * rng.standard_normal(2)
        )
    y = np.array(rows)
    y[10:14, 0] = np.nan
    y[40] = np.nan
    return dataset_from_arrays(0.01 * np.arange(n), {"u": u, "y": y[:, 0], "z": y[:, 1]})


def textbook(data: Dataset, q: FloatArray, r: FloatArray) -> tuple[float, FloatArray]:
    """(negative log likelihood, last S) of the Kalman filter in its two-step form (update, then
    predict)."""
    s = data.segments[0]
    a, b = np.array([[0.9, 0.2], [-0.1, 0.8]]), np.array([1.0, 0.0])
    c = np.array([[1, 0.5], [-0.3, 1]])
    x, p, cost, last = np.zeros(2), np.diag([4.0, 0.49]), 0.0, np.eye(2)
    y = s.matrix(["y", "z"])
    for k in range(s.n):
        there = np.isfinite(y[k])
        ck, rk = c[there], np.diag(r[there])
        e = y[k][there] - ck @ x
        last = ck @ p @ ck.T + rk
        cost += 0.5 * (
            e @ np.linalg.solve(last, e) + np.linalg.slogdet(last)[1] + e.size * np.log(2 * np.pi)
        )
        gain = np.linalg.solve(last, ck @ p).T
        x, p = x + gain @ e, p - gain @ ck @ p
        x, p = a @ x + b * s.column("u")[k], a @ p @ a.T + np.diag(q)
    return float(cost), last


LEVELS = {"noise.process.x1": 0.1, "noise.process.x2": 0.1}


def test_on_a_linear_model_the_filter_is_the_textbook_filter() -> None:
    data = linear_data()
    problem = make_problem(
        linear_model(), data, predictor=Kalman(), criterion=Gaussian(), noise=LEVELS
    )
    cost, _ = textbook(data, np.array([0.01, 0.01]), np.array([0.09, 0.25]))
    assert problem.evaluate(problem.start).likelihood == pytest.approx(cost, abs=1e-10 * abs(cost))


def test_the_stationary_gain_is_the_filters_limit() -> None:
    data = linear_data()
    chosen: dict[str, Any] = {"criterion": Gaussian(), "noise": LEVELS, "estimate_initial": False}
    kalman = make_problem(linear_model(), data, predictor=Kalman(), **chosen)
    fixed = make_problem(linear_model(), data, predictor=Innovation(), **chosen)
    (block,) = kalman.predictor.blocks(kalman, kalman.start, False)
    stationary = Innovation().riccati(fixed, fixed.start, False).S
    root = np.linalg.cholesky(stationary)
    # The stationary solution has a pseudo-sensor of a hundred times the initial spread, hence not
    # to the last digit.
    np.testing.assert_allclose(block.variance[-1], np.diag(root) ** 2, rtol=2e-6)
    (other,) = fixed.predictor.blocks(fixed, fixed.start, False)
    unit = root / np.diag(root)
    np.testing.assert_allclose(block.e[-50:], np.linalg.solve(unit, other.e[-50:].T).T, atol=2e-6)


def test_filter_and_stationary_form_agree_on_the_motor() -> None:
    data = motor.record(torque_noise=0.002)
    slow = make_problem(motor.model(), data, predictor=Innovation(), criterion=Gaussian())
    start, _ = LevenbergMarquardt().solve(slow, equation_error(slow))
    full = make_problem(motor.model(), data, predictor=Kalman(), criterion=Gaussian())
    theta, status = LevenbergMarquardt().solve(full, start[: full.n])
    assert status.converged
    error = np.sqrt(np.diag(np.linalg.inv(full.evaluate(theta).hessian)))
    off = np.abs(theta - start[: full.n]) / error
    # The friction torque bends within a swing, which only the filter's moving linearisation sees: b
    # and c differ more.
    assert off[:4].max() < 0.2
    assert off[:6].max() < 1.5


# ---------------------------------------------------------------------------------------- k steps


def test_one_step_ahead_are_the_innovations() -> None:
    data = with_gaps(motor.record(torque_noise=0.002))
    chosen: dict[str, Any] = {"criterion": Gaussian(), "estimate_noise": False}
    ahead = make_problem(motor.model(), data, predictor=KStep(k=1), **chosen)
    one = make_problem(motor.model(), data, predictor=Innovation(), **chosen)
    (a,), (b,) = (p.predictor.blocks(p, p.start, True) for p in (ahead, one))
    np.testing.assert_allclose(a.e, b.e, atol=1e-12)
    np.testing.assert_allclose(a.jacobian, b.jacobian, atol=1e-10 * np.abs(b.jacobian).max())


def test_as_many_steps_as_samples_are_the_simulation() -> None:
    data = motor.record(n=200)
    ahead = make_problem(motor.model(), data, predictor=KStep(k=200), criterion=Gaussian())
    free = make_problem(motor.model(), data, predictor=Simulation(), criterion=Gaussian())
    (a,), (b,) = (p.predictor.blocks(p, p.start, True) for p in (ahead, free))
    np.testing.assert_allclose(a.e, b.e, atol=1e-12)


# ------------------------------------------------------------------------------ multiple shooting


def lorenz() -> StateSpaceModel:
    """The Lorenz system: errors of a simulation grow e-fold every 1.1 time units, the hard case for
    a long record."""

    def f(t: Any, x: Any, u: Any, p: Any) -> list[Any]:
        return [
            p["sigma"] * (x[1] - x[0]),
            x[0] * (p["rho"] - x[2]) - x[1] + u,
            x[0] * x[1] - p["beta"] * x[2],
        ]

    names = [Signal(name=n, unit="1") for n in "xyz"]
    start = {"sigma": 8.0, "rho": 35.0, "beta": 2.0}
    return StateSpaceModel(
        name="Lorenz",
        states=Layout(names),
        inputs=Layout([Signal(name="u", unit="1")]),
        outputs=Layout(names),
        parameters=tuple(
            Parameter(name=n, unit="1", nominal=v, scale=v, lower=0.1 * v, upper=10 * v)
            for n, v in start.items()
        ),
        dynamics=f,
        measurement=lambda t, x, u, p: [x[0], x[1], x[2]],
        initial_sigma=dict.fromkeys("xyz", 5.0),
        sensor_sigma=dict.fromkeys("xyz", 0.3),
    )


@functools.cache
def orbit(seconds: float = 6.0, dt: float = 0.02) -> Dataset:
    """sigma = 10, rho = 28, beta = 8/3, measured with noise 0.3, by a fine explicit integration."""
    rng = np.random.default_rng(0)
    x, y, z, rows = -8.0, 7.0, 27.0, []
    for k in range(round(seconds / dt)):
        noise = 0.3 * rng.standard_normal(3)
        rows.append((k * dt, 0.0, x + noise[0], y + noise[1], z + noise[2]))
        h = dt / 2000
        for _ in range(2000):
            x, y, z = x + h * 10 * (y - x), y + h * (x * (28 - z) - y), z + h * (x * y - 8 / 3 * z)
    columns = np.array(rows).T
    return dataset_from_arrays(columns[0], dict(zip("uxyz", columns[1:])))


def shooting(window: float) -> Problem:
    return make_problem(
        lorenz(), orbit(), predictor=MultipleShooting(window_s=window), criterion=Gaussian()
    )


@pytest.mark.parametrize("window", [0.2, 0.5, 1.0])
def test_shooting_finds_the_orbit_that_simulation_misses(window: float) -> None:
    problem = shooting(window)
    lost, _ = LevenbergMarquardt().solve(problem, problem.start)
    start = problem.predictor.approach(problem, problem.start)
    theta, status = LevenbergMarquardt().solve(problem, start)
    assert status.converged
    assert theta[:3] == pytest.approx([10.0, 28.0, 8 / 3], rel=0.01)
    assert problem.evaluate(lost).cost > problem.evaluate(theta).cost + 1000


def test_shooting_and_simulation_have_the_same_cost_everywhere() -> None:
    problem = shooting(0.5)
    free = make_problem(lorenz(), orbit(), predictor=Simulation(), criterion=Gaussian())
    theta = problem.start + 0.1 * problem.scale
    assert problem.evaluate(theta).cost == free.evaluate(theta).cost


def test_shooting_alone_ends_close_to_the_optimum() -> None:
    problem = shooting(0.5)
    start = problem.predictor.approach(problem, problem.start)
    best, status = LevenbergMarquardt(tolerance=1e-9).solve(problem, start)
    assert status.converged
    assert problem.evaluate(start).cost - problem.evaluate(best).cost < 1e-2


def test_a_window_that_is_not_finite_is_named_by_its_sample() -> None:
    none = np.zeros((0, 1))
    lost = Windows(innovations=none, sensitivity=None, ends=none, end_sensitivity=None, failed_in=2)
    with pytest.raises(FitError, match="flight a that begins at sample 30 is not finite"):
        lost.demand_finite("flight a", np.array([0, 15, 30]))
    with pytest.raises(FitError, match="flight a that begins at sample 2 is not finite"):
        lost.demand_finite("flight a")
