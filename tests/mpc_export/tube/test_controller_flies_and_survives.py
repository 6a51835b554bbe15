"""The controller holds a place without offset under a constant force, keeps its limits, and
survives what goes wrong."""

import functools
from types import SimpleNamespace

import numpy as np
import pytest

from mpc_export.tube.controller import TubeController
from mpc_export.tube.problem import TubeProblem
from tests.mpc_export import cases


class Hover:
    """Stay at (0, 0, 1), heading 0.3."""

    def sample(self, time):
        n = len(time)
        zero = np.zeros((n, 3))
        return SimpleNamespace(
            position=np.tile([0.0, 0.0, 1.0], (n, 1)),
            velocity=zero,
            acceleration=zero,
            yaw=np.full(n, 0.3),
        )


@functools.cache
def pilot(calibrate: bool = False):
    """One for all tests of a process: building it takes longer than flying it. Each begins with
    `start`."""
    return TubeController(
        model=cases.disturbed(),
        problem=TubeProblem(dt=0.02, horizon=8, planes=2, rate_max=0.05),
        reference=Hover(),
        kappa=(2.0, 2.0, 2.0),
        kappa_u=1.0,
        calibrate=calibrate,
    )


@pytest.fixture
def controller():
    return pilot()


def fly(controller, steps, *, start=None, force=0.0, seen=lambda k, y: y):
    """The model itself as the plant, at the filter's sample time, with a constant force on x."""
    functions = controller.filter
    controller.start()
    x = controller.estimate.copy() if start is None else start
    names = functions.states.names
    path, commands = [], []
    u = controller.u
    for k in range(steps):
        x[names.index("disturbance.force.x")] = force
        y = functions["h"](x, u, functions.parameter_values).full().ravel()
        measured = dict(zip(functions.outputs.names, y.tolist()))
        new = controller.sample(0.01 * k, seen(k, measured))
        x = functions["f_d"](x, u, functions.parameter_values).full().ravel()
        path.append(x[[names.index(f"position.{a}") for a in "xyz"]])
        commands.append(np.array(new))
        u = new
    return np.array(path), np.array(commands)


def test_hovers_without_offset_under_a_constant_force(controller):
    force = 0.1 * 9.81 * controller.model.values["mass"]
    path, commands = fly(controller, 500, force=force)
    assert np.abs(path[:100] - [0, 0, 1]).max() > 0.002  # the push was felt
    np.testing.assert_allclose(path[-1], [0.0, 0.0, 1.0], atol=1e-3)
    assert not controller.events
    assert commands.min() >= controller.problem.command_min
    assert commands.max() <= controller.problem.command_max
    assert np.abs(np.diff(commands, axis=0)).max() <= controller.problem.rate_max + 1e-6


def test_measurements_that_stop_are_noted_and_outlived(controller):
    lost = range(100, 120)
    path, commands = fly(
        controller, 300, seen=lambda k, y: dict.fromkeys(y, np.nan) if k in lost else y
    )
    assert [e.time for e in controller.events] == pytest.approx([0.01 * k for k in lost])
    assert np.isfinite(commands).all()
    np.testing.assert_allclose(path[-1], [0.0, 0.0, 1.0], atol=5e-3)


def test_a_solver_that_fails_leaves_the_plan_before_and_the_ancillary_gain(controller):
    def seen(k, y):
        controller.solver.data["penalty"][()] = (
            np.nan if 100 <= k < 130 else controller.problem.penalty
        )
        return y

    path, commands = fly(controller, 300, seen=seen)
    assert len(controller.events) == 15
    assert all(e.what.startswith("no solution") for e in controller.events)
    assert np.isfinite(commands).all()
    np.testing.assert_allclose(path[-1], [0.0, 0.0, 1.0], atol=5e-3)


def test_the_same_flight_twice_is_the_same_to_the_last_bit(controller):
    one, two = (fly(controller, 60, force=0.02)[1] for _ in range(2))
    np.testing.assert_array_equal(one, two)


@functools.cache
def far_sighted():
    """The horizon and rates of a desktop, a wall 2 cm off its place."""
    own = TubeController(
        model=cases.disturbed(),
        problem=TubeProblem(dt=0.02, horizon=20, planes=2),
        reference=Hover(),
        kappa=(2.0, 2.0, 2.0),
        kappa_u=1.0,
    )
    wall = np.zeros((21, 2, 4))
    wall[..., 3] = 1.0
    wall[:, 0] = [1.0, 0.0, 0.0, 0.02]
    own.planes = lambda times: wall
    return own


@pytest.mark.slow
@pytest.mark.parametrize(("beyond", "away"), [(1.0, 1.5), (2.0, 0.0), (-0.3, 4.0), (-0.5, 4.0)])
def test_a_craft_beyond_a_wall_or_too_fast_before_it_comes_back_upright(beyond, away):
    """All sensors are well. A plane out of reach bought any tilt: 97, 154, 174 and 175 degrees."""
    own = far_sighted()
    f, names = own.filter, own.filter.states.names
    own.start()
    x, tilts = own.estimate.copy(), []
    x[names.index("position.x")], x[names.index("velocity.x")] = beyond, away
    own.start(x)
    u = own.u
    for k in range(300):
        y = f["h"](x, u, f.parameter_values).full().ravel().tolist()
        new = own.sample(0.01 * k, dict(zip(f.outputs.names, y, strict=True)))
        x, u = f["f_d"](x, u, f.parameter_values).full().ravel(), np.array(new)
        turned = np.linalg.norm(x[[names.index(f"attitude.{a}") for a in "xy"]])
        tilts.append(2 * np.arcsin(min(turned, 1.0)))
    assert max(tilts) < own.problem.tilt_max + np.radians(5)
    assert abs(x[names.index("position.x")]) < 0.02
    said = [e for e in own.events if e.what.startswith("a limit is not held by the plan: plane 0")]
    assert said and max(e.time for e in said) < 2.0
