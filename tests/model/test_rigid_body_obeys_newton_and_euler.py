"""Newton and Euler: invariants of free motion, signs of every moment, the paper's plus layout,
convergence of the step."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from craft import CROOKED, PLUS, blocks, flat, function, model_of, rotation, sensors, state, vector

from greybox.plants.presets import NANO, X250

POSE = sensors("position", "velocity", "attitude", "gyro", "accelerometer")
FREE = replace(CROOKED, thrust=(0.0, 0.0, 1.0), torque=(0.0, 0.0, 1.0))
"""Without a constant part in the maps a command of zero is no thrust at all."""
IDLE = np.zeros(4)
QUIET = np.zeros(6)


def inertia(frame):
    return np.array(frame.inertia_matrix, dtype=float).reshape(3, 3)


def stepped(model, x, u, seconds, dt, p=None):
    p = vector(model) if p is None else p
    n = round(seconds / dt)
    # Many steps in one call.
    many = function(model, "step").mapaccum("many", n)
    return np.asarray(many(x, np.tile(np.reshape(u, (-1, 1)), (1, n)), p, QUIET, dt).full())


def test_the_gyroscopic_moment_does_no_work():
    model = model_of(FREE, sensors=POSE)
    f = function(model, "f")
    rng = np.random.default_rng(0)
    for _ in range(20):
        omega = 5 * rng.normal(size=3)
        alpha = blocks(model, flat(f(state(model, rate=omega), IDLE, vector(model))))["rate"]
        moment = inertia(FREE) @ alpha  # = -omega x J omega
        assert np.linalg.norm(moment) > 1e-3
        np.testing.assert_allclose(moment, -np.cross(omega, inertia(FREE) @ omega), rtol=1e-10)
        assert abs(omega @ moment) < 1e-13


def test_torque_free_tumbling_keeps_angular_momentum_in_the_world_and_energy():
    model = model_of(FREE, sensors=POSE)
    x0 = state(model, rate=[6.0, -3.0, 2.0], velocity=[1.0, 2.0, 3.0])
    path = stepped(model, x0, IDLE, 2.0, 0.001)
    jay = inertia(FREE)

    def invariants(x):
        b = blocks(model, x)
        kinetic = 0.5 * b["rate"] @ jay @ b["rate"]
        flight = (
            0.5 * FREE.mass * b["velocity"] @ b["velocity"]
            + FREE.mass * FREE.gravity * b["position"][2]
        )
        return rotation(b["attitude"]) @ jay @ b["rate"], kinetic, flight

    momentum, kinetic, flight = invariants(x0)
    later = invariants(path[:, -1])
    np.testing.assert_allclose(later[0], momentum, atol=1e-9 * np.linalg.norm(momentum))
    assert later[1] == pytest.approx(kinetic, rel=1e-9)
    assert later[2] == pytest.approx(flight, rel=1e-12)
    turned = blocks(model, path[:, -1])["rate"] - [6.0, -3.0, 2.0]
    assert np.linalg.norm(turned) > 1.0, "a triaxial body tumbles"


def test_free_flight_is_a_parabola():
    model = model_of(FREE, sensors=POSE)
    x0 = state(model, velocity=[2.0, -1.0, 3.0], rate=[1.0, 2.0, 3.0])
    after = blocks(model, stepped(model, x0, IDLE, 1.0, 0.01)[:, -1])
    np.testing.assert_allclose(after["position"], [2.0, -1.0, 3.0 - 0.5 * 9.80665], atol=1e-12)
    np.testing.assert_allclose(after["velocity"], [2.0, -1.0, 3.0 - 9.80665], atol=1e-12)


def test_the_quaternion_stays_unit_for_ten_thousand_steps():
    model = model_of(FREE, sensors=POSE)
    path = stepped(model, state(model, rate=[9.0, -7.0, 8.0]), IDLE, 100.0, 0.01)
    at = model.states["attitude.w"]
    assert np.abs(np.linalg.norm(path[at : at + 4], axis=0) - 1).max() < 1e-12


@pytest.mark.parametrize(
    "effects", [(), ("rotor_drag", "rotational_damping"), ("motor_lag", "rotor_drag")]
)
def test_the_step_converges_with_fourth_order(effects):
    model = model_of(CROOKED, *effects, sensors=POSE)
    known = {
        "rotor_drag__k_x": 5e-5,
        "rotor_drag__k_y": 3e-5,
        "rotational_damping__d_p": 4e-3,
        "motor_lag__tau": 0.08,
    }
    p = vector(model, **{k: v for k, v in known.items() if k.split("__")[0] in effects})
    u = np.array([0.56, 0.54, 0.55, 0.53])
    x0 = state(model, velocity=[3.0, 1.0, 0.0], rate=[3.0, -2.0, 1.0], rotor=[0.45, 0.55, 0.5, 0.6])

    def end(dt):
        return stepped(model, x0, u, 0.32, dt, p)[:, -1]

    exact = end(0.0005)
    errors = [np.linalg.norm(end(dt) - exact) for dt in (0.04, 0.02, 0.01)]
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert np.all(orders > 3.6), (errors, orders)
    assert errors[-1] < 1e-5


def moment(frame, u):
    """Body moment [N m] at rest under commands u."""
    model = model_of(frame, sensors=POSE)
    alpha = blocks(model, flat(function(model, "f")(state(model), u, vector(model))))["rate"]
    return inertia(frame) @ alpha


def test_signs_of_the_moments_in_the_flu_frame():
    hover = np.full(4, X250.hover_speed)
    places = np.array([r.position for r in X250.rotors])
    spin = np.array([r.spin for r in X250.rotors])
    more = 0.05
    left, rear, ccw = places[:, 1] > 0, places[:, 0] < 0, spin > 0
    roll, pitch, yaw = (moment(X250, hover + more * chosen) for chosen in (left, rear, ccw))
    assert roll[0] > 0, "more on the left rolls to the right"
    assert np.abs(roll[1:]).max() < 1e-15
    assert pitch[1] > 0, "more at the rear pitches the nose down, q > 0"
    assert np.abs(pitch[[0, 2]]).max() < 1e-15
    assert yaw[2] < 0, "a counter-clockwise rotor turns the body clockwise"
    assert np.abs(yaw[:2]).max() < 1e-15


def test_positive_q_is_nose_down_and_positive_roll_moves_right():
    model = model_of(X250, sensors=POSE)
    hover = np.full(4, X250.hover_speed)
    down = blocks(model, stepped(model, state(model, rate=[0, 1.0, 0]), hover, 0.2, 0.01)[:, -1])
    assert (rotation(down["attitude"]) @ [1, 0, 0])[2] < 0, "the nose points down"
    assert down["velocity"][0] > 0, "and the craft goes forward"
    right = blocks(model, stepped(model, state(model, rate=[1.0, 0, 0]), hover, 0.2, 0.01)[:, -1])
    assert right["velocity"][1] < 0, "to the right, y being left"


def test_the_papers_plus_layout():
    """tau = [l(F2 - F4), l(F3 - F1), kappa(F1 - F2 + F3 - F4)]: 1 front, 2 left, 3 back, 4 right; 1
    and 3 clockwise."""
    rng = np.random.default_rng(1)
    arm, kappa = PLUS.rotors[0].position[0], PLUS.torque[2] / PLUS.thrust[2]
    for _ in range(5):
        u = rng.uniform(0.3, 0.8, size=4)
        f1, f2, f3, f4 = PLUS.thrust[2] * u**2
        expected = [arm * (f2 - f4), arm * (f3 - f1), kappa * (f1 - f2 + f3 - f4)]
        np.testing.assert_allclose(moment(PLUS, u), expected, rtol=1e-10, atol=1e-14)


@pytest.mark.parametrize("frame", [NANO, X250, PLUS], ids=lambda f: f.name)
def test_hover_is_an_equilibrium_of_every_craft(frame):
    model = model_of(frame, sensors=POSE)
    rate = flat(function(model, "f")(state(model), np.full(4, frame.hover_speed), vector(model)))
    assert np.abs(rate).max() < 1e-12
    seen = dict(
        zip(
            model.outputs.names,
            flat(function(model, "h")(state(model), np.full(4, frame.hover_speed), vector(model))),
            strict=True,
        )
    )
    assert [seen["ax"], seen["ay"], seen["az"]] == pytest.approx([0, 0, frame.gravity])


def test_gravity_has_no_moment_about_an_offset_centre_of_mass():
    model = model_of(FREE, "center_of_mass_offset", sensors=POSE)
    p = vector(model, center_of_mass_offset__c_x=0.05, center_of_mass_offset__c_z=0.02)
    x = state(model, attitude=[0.8, 0.6, 0.0, 0.0])
    assert np.abs(blocks(model, flat(function(model, "f")(x, IDLE, p)))["rate"]).max() == 0.0


def test_force_noise_is_felt_by_velocity_and_accelerometer_alike():
    """White force of the coming step: dv = R w dt / m and a = w / m, the same w."""
    model = model_of(X250, sensors=POSE)
    x = state(model, attitude=[0.8, 0.0, 0.6, 0.0])
    u, p, dt = np.full(4, 0.5), vector(model), 0.01
    step, output = function(model, "step"), function(model, "output")
    w = np.array([0.1, -0.2, 0.3, 0, 0, 0])
    kick = flat(step(x, u, p, w, dt)) - flat(step(x, u, p, QUIET, dt))
    seen = flat(output(x, u, p, w, dt)) - flat(output(x, u, p, QUIET, dt))
    np.testing.assert_allclose(
        blocks(model, kick)["velocity"], rotation([0.8, 0, 0.6, 0]) @ w[:3] * dt / 0.5, rtol=1e-9
    )
    rows = [model.outputs[n] for n in ("ax", "ay", "az")]
    np.testing.assert_allclose(seen[rows], w[:3] / 0.5, rtol=1e-9)
    assert np.abs(np.delete(seen, rows)).max() == 0.0


def test_numbers_go_in_where_symbols_do():
    model = model_of(CROOKED)
    x, u, p = ca.DM(state(model)), ca.DM([0.5] * 4), ca.DM(vector(model))
    assert isinstance(model.f(0, x, u, p), ca.DM)
    np.testing.assert_array_equal(flat(model.f(0, x, u, p)), flat(function(model, "f")(x, u, p)))
