"""The controller's own solver and IPOPT find the same plan, with binding planes, rate limits,
back-offs and slack."""

import functools

import numpy as np
import pytest

from mpc_export.functions import model_functions
from mpc_export.tube.problem import TubeProblem
from mpc_export.tube.solver import TubeSolver
from scenarios.studies.tube_ipopt import IpoptSolver
from tests.mpc_export import cases


@functools.cache
def pair():
    model = cases.disturbed()
    functions = model_functions(model, dt=0.02, with_=("covariance", "target"))
    solver = TubeSolver(functions, TubeProblem(horizon=8, planes=2, rate_max=0.04))
    return solver, IpoptSolver(solver)


def pose(solver, offset):
    """A start on the move toward a wall at `offset` metres, with a reference behind it."""
    solver.reset()
    d = solver.data
    names = solver.model.states.names
    d["x0"][names.index("position.x")], d["x0"][names.index("velocity.x")] = -0.03, 0.5
    d["x0"][names.index("disturbance.force.x")] = 0.02
    d["ref"][:, 0], d["x_end"][names.index("position.x")] = 0.1, 0.1
    d["kappa"][:], d["kappa_u"][()] = 2.0, 1.0
    d["plane"][:, 0] = [1.0, 0.0, 0.0, offset]
    d["iterations_max"][()] = 200
    return d


@pytest.mark.parametrize(("offset", "beyond"), [(0.08, False), (-0.02, True)])
def test_converged_plans_are_equal(offset, beyond):
    solver, reference = pair()
    d = pose(solver, offset)
    outcome = solver.solve()
    assert outcome.status == 0
    assert outcome.kkt <= 1e-6
    plan, backoff, backoff_u = d["u"].copy(), d["backoff"].copy(), d["backoff_u"].copy()
    slack = d["slack"][1:, 0].max()
    assert (slack > 1e-3) == beyond
    d = pose(solver, offset)
    d["backoff"][:], d["backoff_u"][:] = backoff, backoff_u
    found = reference.solve()
    np.testing.assert_allclose(plan, found.u, atol=1e-4)
    assert np.abs(np.diff(found.u, axis=0)).max() > 0.0399  # the rate limit binds
    assert found.slack[:, 0].max() == pytest.approx(slack, abs=1e-5)


def test_one_iteration_is_the_first_of_many():
    solver, _ = pair()
    d = pose(solver, 0.08)
    d["iterations_max"][()] = 1
    solver.solve()
    first = d["u"].copy()
    d = pose(solver, 0.08)
    d["iterations_max"][()] = 2
    d["tolerance"][()] = 0.0
    outcome = solver.solve()
    assert outcome.iterations == 2
    assert 0 < np.abs(d["u"] - first).max() < 0.2


def test_a_plan_is_repeated_bit_for_bit():
    solver, _ = pair()
    plans = []
    for _ in range(2):
        d = pose(solver, 0.08)
        solver.solve()
        plans.append(d["u"].copy())
    np.testing.assert_array_equal(*plans)
