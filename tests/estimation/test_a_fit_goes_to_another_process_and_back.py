"""A fit can be pickled, copied and returned by a process pool, with a compiler and without one; what
comes back gives the same numbers, and its problem goes on where it was."""

from __future__ import annotations

import copy
import multiprocessing
import pickle
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from greybox import build_model, fit, profile
from greybox.estimation.result import Fit
from tests import motor
from tests.simulated import flights, vehicle

FEW = {"free": ("motor_lag.tau", "thrust.c2"), "estimate_noise": False, "disturbance": ("torque",)}


def fitted(compiled: bool = True) -> Fit:
    data = flights(1, seconds=2.0)
    model = build_model(vehicle(), data.channels, ["motor_lag"], sample_time=0.01)
    return fit(model, data, use_compiler=compiled, **FEW)


def same(a: Fit, b: Fit) -> bool:
    return (
        a.summary() == b.summary()
        and np.array_equal(a.theta, b.theta)
        and a.to_dict() == b.to_dict()
        and np.array_equal(a.covariance.matrix, b.covariance.matrix, equal_nan=True)
    )


@pytest.fixture(scope="module", params=["compiled", "no compiler"])
def found(request) -> Fit:
    return fitted(request.param == "compiled")


@pytest.mark.parametrize(
    "copied",
    [lambda f: pickle.loads(pickle.dumps(f)), copy.deepcopy, copy.copy],
    ids=["pickle", "deepcopy", "copy"],
)
def test_a_copy_is_the_same_fit(copied, found):
    again = copied(copied(found))
    assert same(again, found)
    problem = again.problem
    assert problem.evaluate(again.theta).cost == found.problem.evaluate(found.theta).cost
    assert problem.engine.compiled == found.problem.engine.compiled
    assert dict(problem.means) == dict(found.problem.means)


def test_what_was_worked_out_is_no_obstacle(found):
    space = found.problem
    assert space.index and space.bodies is not None
    assert pickle.loads(pickle.dumps(space)).index == space.index


def test_a_fit_of_equations_without_a_name_goes_too():
    """Lambdas, and functions within one, are found by no other process: their equations go."""
    named = motor.model()
    nameless = replace(named, dynamics=lambda t, x, u, p: named.dynamics(t, x, u, p))
    first = fit(nameless, motor.record(), free=["R"], estimate_noise=False)
    again = pickle.loads(pickle.dumps(first))
    assert same(again, first)
    assert again.problem.evaluate(again.theta).cost == first.problem.evaluate(first.theta).cost
    assert pickle.loads(pickle.dumps(named)).dynamics is named.dynamics


def test_a_copy_can_be_profiled(found):
    again = pickle.loads(pickle.dumps(found))
    one, other = (profile(f, "motor_lag.tau", grid=[0.04, 0.06]) for f in (found, again))
    assert np.array_equal(one.cost, other.cost)


@pytest.mark.parametrize("compiled", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_pool_returns_fits(compiled):
    spawn = multiprocessing.get_context("spawn")  # as on every system
    with ProcessPoolExecutor(1, mp_context=spawn) as pool:
        (found,) = pool.map(fitted, [compiled])
    assert np.allclose(found.theta, fitted(compiled).theta, rtol=1e-9)
    assert np.isfinite(found.problem.evaluate(found.theta).cost)
