"""A craft that hovers near the end of its command range holds its place: its heading gives way
first, and limits of the commands are tightened no further than it can hover."""

import functools

import numpy as np
import pytest

from mpc_export.tube.controller import TubeController
from mpc_export.tube.heading import turning, within
from mpc_export.tube.problem import TubeProblem
from tests.mpc_export import cases
from tests.mpc_export.tube.test_controller_flies_and_survives import Hover

CROSS = np.array([[1.0, 1.0, 0.0], [-1.0, 1.0, 0.0], [-1.0, -1.0, 0.0], [1.0, -1.0, 0.0]])


@pytest.mark.parametrize("moved", [0.0, 0.3])
def test_a_turn_neither_lifts_nor_tilts_wherever_the_centre_of_mass_is(moved):
    way = turning(CROSS + np.array([moved, 0.0, 0.0]), np.array([1.0, -1.0, 1.0, -1.0]))
    np.testing.assert_allclose(way, [0.5, -0.5, 0.5, -0.5], atol=1e-12)


def test_six_rotors_turn_with_all_and_three_not_at_all():
    angles = np.pi / 3 * np.arange(6)
    six = np.column_stack([np.cos(angles), np.sin(angles), 0 * angles])
    way = turning(six, np.array([1.0, -1.0] * 3))
    assert np.abs(np.column_stack([np.ones(6), six]).T @ way).max() < 1e-12
    assert abs(way @ [1.0, -1.0, 1.0, -1.0, 1.0, -1.0]) > 2.4
    np.testing.assert_array_equal(turning(six[::2], np.ones(3)), np.zeros(3))


def test_a_command_moves_along_the_turn_alone_and_as_little_as_it_must():
    way = turning(CROSS, np.array([1.0, -1.0, 1.0, -1.0]))
    asked = np.array([1.05, 0.6, 1.0, 0.65])
    held, moved = within(asked, way, 0.05, 0.95)
    np.testing.assert_allclose(held**2 - asked**2, moved * way, atol=1e-12)
    assert held.max() == pytest.approx(0.95)
    inside = np.array([0.9, 0.2, 0.9, 0.2])
    assert within(inside, way, 0.05, 0.95) == (pytest.approx(inside), 0.0)
    assert within(np.array([1.0, 0.94, 1.0, 0.94]), way, 0.05, 0.95) is None  # too heavy


def pilot(room: float, kappa_u: float = 1.0) -> TubeController:
    """With `room` above the largest of its hover commands."""
    model = cases.disturbed()
    hover = float(_hover().max())
    return TubeController(
        model=model,
        problem=TubeProblem(dt=0.02, horizon=8, planes=2, command_max=hover + room),
        reference=Hover(),
        kappa=(2.0, 2.0, 2.0),
        kappa_u=kappa_u,
    )


@functools.cache
def _hover() -> np.ndarray:
    free = TubeController(
        model=cases.disturbed(),
        problem=TubeProblem(dt=0.02, horizon=8, planes=2),
        reference=Hover(),
    )
    return free.solver.stages.steady[1]


def fly(controller, steps, *, torque=lambda k: 0.0):
    """The model itself as the plant under a torque about z; heights and rates."""
    f = controller.filter
    controller.start()
    x, u, seen = controller.estimate.copy(), controller.u, []
    names = f.states.names
    for k in range(steps):
        x[names.index("disturbance.torque.z")] = torque(k)
        y = f["h"](x, u, f.parameter_values).full().ravel()
        new = controller.sample(0.01 * k, dict(zip(f.outputs.names, y.tolist(), strict=True)))
        x = f["f_d"](x, u, f.parameter_values).full().ravel()
        seen.append([x[names.index(n)] for n in ("position.z", "rate.z")])
        u = new
    return np.array(seen).T


def test_limits_are_tightened_no_further_than_the_craft_can_hover():
    controller = pilot(room=0.02, kappa_u=50.0)
    height, _ = fly(controller, 200)
    assert np.abs(height[100:] - 1.0).max() < 5e-3
    assert not controller.descending
    assert float(controller.solver.data["kappa_u"]) < 50.0


def test_tightening_that_no_room_is_left_for_does_not_come_back_in_full():
    controller = pilot(room=0.02, kappa_u=2.0)
    data, (x, u) = controller.solver.data, controller.steady
    controller.steady = (x, np.full_like(u, controller.problem.command_max))
    for _ in range(120):
        data["backoff_u"][:] = 0.01 * data["kappa_u"][()]
        data["kappa_u"][()] = controller._affordable()
        assert 0.0 < data["kappa_u"][()] <= 2e-6 * (1.0 + 1e-12)
    controller.steady = (x, u)
    data["backoff_u"][:] = 0.01 * data["kappa_u"][()]
    room = controller.problem.command_max - u.max()
    assert controller._affordable() == pytest.approx(0.5 * room / 0.01)


def lacking(controller, times):
    """`times` the torque about z that the rotors can spare at hover [N m]."""
    spare = controller.problem.command_max**2 - _hover().max() ** 2
    return times * 4.0 * controller.model.values["torque.c2"] * spare


def test_a_craft_that_cannot_hold_its_heading_for_a_second_holds_its_place():
    controller = pilot(room=0.03)
    torque = lacking(controller, 1.1)
    height, rate = fly(controller, 300, torque=lambda k: torque * (50 <= k < 150))
    assert np.abs(rate).max() > 0.1  # it was felt
    assert np.abs(height - 1.0).max() < 5e-2
    assert not controller.descending
    assert abs(rate[-1]) < 0.05


def test_a_craft_that_spins_up_comes_down():
    controller = pilot(room=0.03)
    torque = lacking(controller, 6.0)
    fly(controller, 300, torque=lambda k: torque)
    assert controller.descending
