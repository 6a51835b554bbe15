"""The QP of a plan: HPIPM, Riccati recursions and the condensed matrix give the same commands; a plan
that fails with one attempt is tried again by the next call."""

import functools
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.tube_on_chip import Circle, pilot_of
from mpc_export.functions import model_functions
from mpc_export.tube.in_process import TubeInC
from mpc_export.tube.library import flight
from mpc_export.tube.problem import TubeProblem
from mpc_export.tube.solver import TubeSolver
from tests.mpc_export import cases

HORIZON = 6


@functools.cache
def functions(model):
    return model_functions(model(), dt=0.02, with_=("covariance", "target"), measured=False)


@functools.cache
def solver(qp, real="double", attempts=2, horizon=HORIZON, model=cases.disturbed):
    problem = TubeProblem(dt=0.02, horizon=horizon, planes=2, attempts=attempts)
    return TubeSolver(functions(model), problem, qp=qp, real=real)


def beside_a_wall(own, seed):
    """Commands of one iteration from a start at speed, close to a wall or beyond it."""
    rng = np.random.default_rng(seed)
    own.reset()
    d = own.data
    d["x0"][:3] += 0.2 * rng.standard_normal(3)
    d["x0"][3:6] += rng.standard_normal(3)
    d["plane"][:, 0] = [1.0, 0.0, 0.0, 0.05]
    d["kappa"][:], d["kappa_u"][()] = 2.0, 1.0
    outcome = own.solve()
    assert outcome.status == 0
    return d["u"].astype(float)


@pytest.mark.parametrize(
    ("qp", "real", "most"),
    [("condensed", "double", 1e-5), ("condensed", "float", 2e-4), ("riccati", "double", 1e-5)],
)
def test_commands_are_those_of_hpipm(qp, real, most):
    moved = []
    for seed in range(4):
        expected = beside_a_wall(solver("hpipm"), seed)
        assert np.abs(beside_a_wall(solver(qp, real), seed) - expected).max() < most
        moved.append(np.ptp(expected))
    assert max(moved) > 0.3  # limits were reached


@pytest.mark.slow
def test_a_craft_that_hovers_tilted_has_the_same_plan():
    """Planes then feel all places. GCC 12 lost sums of the condensed matrix (-O3 -march=znver3)."""
    for seed in (0, 3):
        expected = beside_a_wall(solver("hpipm", model=cases.hybrid), seed)
        found = beside_a_wall(solver("condensed", model=cases.hybrid), seed)
        assert np.abs(found - expected).max() < 1e-5


def test_float_ends_no_sooner_than_double():
    """It ended at a hundred times the product of distance and multiplier: commands were up to
    1.3e-3 off in flight."""
    sooner = []
    for seed in range(12):
        ends = []
        for real in ("double", "float"):
            own = solver("condensed", real)
            ends.append((beside_a_wall(own, seed), int(own.data["qp_iterations"])))
        (expected, enough), (found, taken) = ends
        assert np.abs(found - expected).max() < 1e-4
        sooner.append(enough - taken)
    assert max(sooner) <= 0


@pytest.mark.slow
def test_float_meets_limits_of_places_that_commands_hardly_move(tmp_path):
    """Circle 8 meets its wall at the beginning of a horizon. As soft as a command's, that limit was
    missed by 3e-6 m whatever the iterations: commands were 2.9e-3 off."""
    arguments = SimpleNamespace(linear=False, attempts=1)
    pilot, path = pilot_of(cases.disturbed(), 10, arguments), Circle(8)
    pilot.reference, pilot.planes = path, path.planes
    measured = flight(pilot, 200, 8, None)["measured"]
    commands = []
    for real in ("double", "float"):
        flown = TubeInC(pilot, tmp_path, real=real)
        rows = enumerate(measured)
        flown.start()
        commands.append(
            [flown.sample(k * flown.dt, dict(zip(flown.columns, y, strict=True))) for k, y in rows]
        )
    assert np.abs(np.subtract(*commands)).max() < 1e-4


@pytest.mark.slow
def test_riccati_recursions_in_float_solve_long_horizons():
    """The slope rounds with the sums that it is of: no plan of 20 stages and more was solved to the
    end. Commands were right all the same, and are."""
    own, expected = (solver("riccati", real, horizon=40) for real in ("float", "double"))
    for seed in range(4):
        off = np.abs(beside_a_wall(own, seed) - beside_a_wall(expected, seed)).max()
        assert off < 3e-4
        assert float(own.data["qp_status"]) == 0
        assert float(own.data["qp_iterations"]) <= 20


def test_with_one_attempt_the_next_call_begins_at_flown_commands():
    """After a failure the plan is the one before, to the last bit; the next call finds one that a
    second attempt would have found."""
    one, two = solver("condensed", attempts=1), solver("condensed")
    for own in (one, two):
        own.reset()
        own.data["x0"][3:6] = [2.0, -1.0, 0.5]
        own.data["x"][1:] = np.nan
    kept = one.data["x"].copy(), one.data["u"].copy()
    assert one.solve().status in (1, 2)
    assert float(one.data["failed"]) == 1.0
    for now, then in zip((one.data["x"], one.data["u"]), kept, strict=True):
        np.testing.assert_array_equal(now[1:], then[1:])
    assert one.solve().status == two.solve().status == 0
    assert float(one.data["failed"]) == 0.0
    assert np.abs(one.data["u"] - two.data["u"]).max() < 1e-9


def test_a_function_of_the_model_that_fails_is_not_a_qp_that_does():
    """A NaN among the model's numbers was called an unsolved QP."""
    own = solver("condensed")
    own.reset()
    own.data["p"][:] = np.nan
    own.data["ref"][2, 0] = np.nan
    outcome = own.solve()
    assert outcome.status == 1
    assert outcome.qp_status == -1  # none was tried
