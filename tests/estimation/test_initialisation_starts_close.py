"""Claims: equation error starts close to the truth, instruments undo its closed-loop bias, noise
starts save iterations."""

from __future__ import annotations

import concurrent.futures
import functools

import numpy as np
import pytest

from greybox import build_model
from greybox.data import Dataset, dataset_from_arrays
from greybox.errors import DataError, UnknownNameError
from greybox.estimation.criteria.gaussian import Gaussian
from greybox.estimation.fit import _initialise
from greybox.estimation.initialisation import equation_error, noise_start
from greybox.estimation.multistart import multistart
from greybox.estimation.options import FitOptions
from greybox.estimation.predictors.innovation import Innovation
from greybox.estimation.predictors.simulation import Simulation
from greybox.estimation.problem import Problem, make_problem
from greybox.estimation.solvers.levenberg_marquardt import LevenbergMarquardt
from greybox.model.dynamics import StateSpaceModel
from greybox.model.parameter import Parameter
from greybox.symbolic import Layout, Signal
from tests import motor
from tests.simulated import flights, truth, vehicle


@functools.cache
def first_order() -> StateSpaceModel:
    """x+ = a x + b u + w, y = x + v, with start values far off."""
    return StateSpaceModel(
        name="first order",
        states=Layout([Signal(name="y", unit="1")]),
        inputs=Layout([Signal(name="u", unit="1")]),
        outputs=Layout([Signal(name="y", unit="1")]),
        parameters=(
            Parameter(name="a", unit="1", nominal=0.5),
            Parameter(name="b", unit="1", nominal=1.0),
        ),
        dynamics=lambda t, x, u, p: [p["a"] * x[0] + p["b"] * u],
        measurement=lambda t, x, u, p: [x[0]],
        discrete=True,
        initial_sigma={"y": 1.0},
        sensor_sigma={"y": 0.3},
    )


def loop(seed: int, n: int = 3000) -> Dataset:
    """a = 0.9, b = 0.5 under feedback u = 0.8 (sp - y): the measurement noise comes back through
    the command."""
    rng = np.random.default_rng(seed)
    sp = np.repeat(rng.choice([-1.0, 1.0], n // 10), 10)
    x, rows = 0.0, []
    for k in range(n):
        y = x + 0.3 * rng.standard_normal()
        u = 0.8 * (sp[k] - y)
        rows.append((0.01 * k, u, y, sp[k]))
        x = 0.9 * x + 0.5 * u + 0.2 * rng.standard_normal()
    t, u, y, setpoint = np.array(rows).T
    return dataset_from_arrays(t, {"u": u, "y": y, "sp": setpoint})


def test_instruments_undo_the_bias_that_feedback_brings() -> None:
    plain, instrumental = [], []
    for seed in range(20):
        problem = make_problem(
            first_order(), loop(seed), predictor=Innovation(), criterion=Gaussian()
        )
        plain.append(equation_error(problem)[1])
        instrumental.append(equation_error(problem, instruments=["sp"])[1])
    error = np.std(instrumental) / np.sqrt(20)
    assert abs(np.mean(plain) - 0.5) > 0.03
    assert abs(np.mean(instrumental) - 0.5) < 4 * error
    assert abs(np.mean(instrumental) - 0.5) < 0.2 * abs(np.mean(plain) - 0.5)


def test_given_values_that_predict_better_than_the_equation_error_are_the_start() -> None:
    options = FitOptions(values={"a": 0.9, "b": 0.5})
    for seed in range(3):
        problem = make_problem(first_order(), loop(seed), options)
        start = _initialise(problem, options, LevenbergMarquardt())
        assert start[:2] == pytest.approx([0.9, 0.5])
        assert (
            problem.evaluate(start).cost
            < problem.evaluate(noise_start(problem, equation_error(problem))).cost
        )


def test_bad_instruments_are_named() -> None:
    problem = make_problem(
        first_order(), loop(0, 200), predictor=Innovation(), criterion=Gaussian()
    )
    with pytest.raises(UnknownNameError, match="spp"):
        equation_error(problem, instruments=["spp"])
    s = loop(0, 200).segments[0]
    still = dataset_from_arrays(s.t, {**s.channels, "sp": np.ones(s.n)})
    problem = make_problem(first_order(), still, predictor=Innovation(), criterion=Gaussian())
    with pytest.raises(DataError, match="never move"):
        equation_error(problem, instruments=["sp"])


def test_equation_error_starts_the_motor_within_a_few_per_cent() -> None:
    problem = make_problem(
        motor.model(), motor.record(), predictor=Simulation(), criterion=Gaussian()
    )
    start = equation_error(problem)
    for i, name in enumerate(("R", "L", "k", "J")):
        assert start[i] == pytest.approx(motor.TRUTH[name], rel=0.03), name


def test_noise_start_finds_the_levels_within_a_factor_two() -> None:
    problem = make_problem(
        motor.model(),
        motor.record(torque_noise=0.002),
        predictor=Innovation(),
        criterion=Gaussian(),
    )
    start = noise_start(problem, equation_error(problem))
    level = {u.name: np.exp(v) for u, v in zip(problem.unknowns, start) if u.kind == "noise"}
    assert level["noise.sensor.current"] == pytest.approx(0.02, rel=0.2)
    # 0.002 N m s^0.5 over 2e-4 kg m^2, constant over 5 ms.
    assert level["noise.process.speed"] == pytest.approx(0.002 / np.sqrt(0.005) / 2e-4, rel=0.5)


@functools.cache
def quadrotor() -> Problem:
    data = flights()
    model = build_model(
        vehicle(), data.channels, ("motor_lag", "command_delay", "rotor_drag", "rotational_damping")
    )
    return make_problem(model, data, predictor=Innovation(), criterion=Gaussian())


def test_the_quadrotor_fit_needs_fewer_than_twelve_iterations() -> None:
    problem = quadrotor()
    start = equation_error(problem)
    for u, v in zip(problem.unknowns, start):
        if u.name in ("inertia.xx", "inertia.yy", "thrust.c2", "motor_lag.tau"):
            assert v == pytest.approx(truth()[u.name], rel=0.05), u.name
    theta, status = LevenbergMarquardt().solve(problem, noise_start(problem, start))
    assert status.converged
    assert status.iterations < 12
    plain, other = LevenbergMarquardt().solve(problem, problem.start)
    assert status.iterations < other.iterations
    assert problem.evaluate(theta, 0).cost == pytest.approx(
        problem.evaluate(plain, 0).cost, abs=1e-4
    )


def test_multistart_finds_the_same_best_whatever_the_executor() -> None:
    problem = make_problem(
        motor.model(), motor.record(), predictor=Simulation(), criterion=Gaussian()
    )
    threads = multistart(problem, LevenbergMarquardt(), n=4, seed=3)
    with concurrent.futures.ThreadPoolExecutor(1) as one:
        again = multistart(problem, LevenbergMarquardt(), n=4, seed=3, executor=one)
    np.testing.assert_array_equal(threads.theta, again.theta)
    assert threads.status[0].converged
    assert (np.diff(threads.cost) >= 0).all()
    assert threads.agreeing >= 1
    assert threads.spread >= 0
    assert threads.best[0] == pytest.approx(motor.TRUTH["R"], rel=0.01)
