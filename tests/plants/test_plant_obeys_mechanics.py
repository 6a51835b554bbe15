"""The simulated plant obeys Newton and Euler: equilibrium, invariants, signs, accelerometers that
feel no gravity."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greybox.plants.airframe import Airframe, Rotor, plus_layout, x_layout
from greybox.plants.effects import (
    BladeFlapping,
    CenterOfMassOffset,
    LinearDrag,
    ParasiticDrag,
    RotationalDamping,
    RotorDrag,
)
from greybox.plants.quadrotor import Quadrotor

FRAME = Airframe(
    name="test",
    mass=0.5,
    inertia=(2.1e-3, 2.9e-3, 3.9e-3),
    products=(2e-4, -1e-4, 1.5e-4),
    rotors=x_layout(0.09, 0.08),
    thrust=(0.0, 0.0, 4.2),
    torque=(0.0, 0.0, 0.055),
    speed_max=2300.0,
)
IDLE = [0.0] * 4


def rotation(q):
    """World from body, by the definition q v q*, independent of the plant's algebra."""
    w, x, y, z = q
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * skew + 2 * skew @ skew


def pick(state, names):
    return np.array([state[n] for n in names.split()])


def test_hover_is_an_equilibrium():
    plant = Quadrotor(FRAME)
    plant.reset(0)
    u = FRAME.hover_speed
    for _ in range(100):
        plant.step([u] * 4, 0.01)
    s = plant.states()
    assert pick(s, "x y z") == pytest.approx([0, 0, 1], abs=1e-10)
    assert pick(s, "p q r vx vy vz") == pytest.approx(np.zeros(6), abs=1e-10)
    assert 4 * 4.2 * u**2 == pytest.approx(0.5 * 9.80665)


def test_an_accelerometer_carried_by_thrust_reads_plus_g():
    plant = Quadrotor(FRAME)
    seen = plant.measure()
    assert [seen["ax"], seen["ay"], seen["az"]] == pytest.approx([0, 0, 9.80665])


def test_free_fall_is_weightless_and_parabolic():
    plant = Quadrotor(replace(FRAME, torque=(0.0, 0.0, 0.0)))
    plant.reset(0, position=(0.0, 0.0, 100.0), velocity=(2.0, -1.0, 3.0))
    for _ in range(100):
        plant.step(IDLE, 0.01)
    seen = plant.measure(IDLE)
    assert [seen["ax"], seen["ay"], seen["az"]] == pytest.approx([0, 0, 0], abs=1e-12)
    assert [seen["x"], seen["y"], seen["z"]] == pytest.approx(
        [2.0, -1.0, 103.0 - 0.5 * 9.80665], abs=1e-9
    )


def test_torque_free_tumbling_keeps_angular_momentum_in_the_world_and_energy():
    plant = Quadrotor(FRAME, substep=0.0005)
    plant.reset(0, rates=(6.0, -3.0, 2.0))
    inertia = np.array(FRAME.inertia_matrix).reshape(3, 3)

    def invariants():
        s = plant.states()
        omega = pick(s, "p q r")
        return rotation(pick(s, "qw qx qy qz")) @ inertia @ omega, 0.5 * omega @ inertia @ omega

    momentum, energy = invariants()
    for _ in range(200):
        plant.step(IDLE, 0.01)
    later, energy_later = invariants()
    assert np.linalg.norm(later - momentum) < 1e-8 * np.linalg.norm(momentum)
    assert abs(energy_later - energy) < 1e-8 * energy


def test_the_quaternion_stays_unit():
    plant = Quadrotor(FRAME, [RotationalDamping(d_p=1e-4)])
    plant.reset(0, rates=(12.0, 9.0, -7.0))
    for _ in range(300):
        plant.step([0.5, 0.6, 0.4, 0.5], 0.01)
    assert np.linalg.norm(pick(plant.states(), "qw qx qy qz")) == pytest.approx(1.0, abs=1e-14)


@pytest.mark.parametrize("layout", [x_layout(0.1, 0.1), plus_layout(0.1)])
def test_stronger_left_rotors_roll_right_and_stronger_rear_rotors_pitch_the_nose_down(layout):
    frame = replace(FRAME, rotors=layout, products=(0.0, 0.0, 0.0), torque=(0.0, 0.0, 0.0))
    for axis, sign in ((1, "p"), (0, "q")):
        plant = Quadrotor(frame)
        u = [
            0.5 + 0.05 * (1 if axis == 1 else -1) * np.sign(rotor.position[axis])
            for rotor in layout
        ]
        for _ in range(5):
            plant.step(u, 0.01)
        seen = plant.measure()
        assert seen[sign] > 0.1
        assert abs(seen["q" if sign == "p" else "p"]) < 1e-12
    # positive p lowers the right side: body y, which points left, gains height
    plant = Quadrotor(frame)
    plant.reset(0, rates=(1.0, 0.0, 0.0))
    plant.step([0.5] * 4, 0.01)
    assert rotation(pick(plant.states(), "qw qx qy qz"))[2, 1] > 0
    # positive q lowers the nose: body x loses height
    plant.reset(0, rates=(0.0, 1.0, 0.0))
    plant.step([0.5] * 4, 0.01)
    assert rotation(pick(plant.states(), "qw qx qy qz"))[2, 0] < 0


def test_a_counter_clockwise_rotor_turns_the_body_clockwise():
    frame = replace(FRAME, rotors=(Rotor((0.0, 0.0, 0.0), 1),), products=(0.0, 0.0, 0.0))
    plant = Quadrotor(frame)
    plant.step([0.5], 0.01)
    assert plant.measure()["r"] == pytest.approx(-0.055 * 0.25 / 3.9e-3 * 0.01, rel=1e-6)


def test_moments_follow_the_published_plus_layout():
    """tau = [l (F2 - F4), l (F3 - F1), kappa (F1 - F2 + F3 - F4)] with rotors 1 and 3 clockwise."""
    frame = replace(FRAME, rotors=plus_layout(0.15), products=(0.0, 0.0, 0.0))
    u = np.array([0.3, 0.5, 0.6, 0.45])
    force = 4.2 * u**2
    kappa = 0.055 / 4.2
    expected = [
        0.15 * (force[1] - force[3]),
        0.15 * (force[2] - force[0]),
        kappa * (force[0] - force[1] + force[2] - force[3]),
    ]
    plant = Quadrotor(frame, substep=1e-5)
    plant.step(u, 1e-5)
    seen = plant.measure()
    assert [seen[n] * j / 1e-5 for n, j in zip("pqr", frame.inertia)] == pytest.approx(
        expected, rel=1e-3
    )


@pytest.mark.parametrize(
    "effect",
    [
        RotorDrag(k_x=1e-4, k_y=2e-4),
        LinearDrag(d_x=0.2, d_y=0.3, d_z=0.1),
        ParasiticDrag(c_x=0.02, c_y=0.03, c_z=0.04),
        RotationalDamping(d_p=1e-3, d_r=2e-3),
    ],
)
def test_drag_takes_energy_away(effect):
    plain, dragged = Quadrotor(FRAME), Quadrotor(FRAME, [effect])
    for plant in (plain, dragged):
        plant.reset(0, velocity=(3.0, -2.0, 1.0), rates=(2.0, 0.5, 3.0))
    inertia = np.array(FRAME.inertia_matrix).reshape(3, 3)
    # power of the effect's force and moment: difference of the accelerations with and without it
    u = [0.5] * 4
    accelerations = []
    for plant in (plain, dragged):
        speeds, _ = plant._speeds_now(u)
        _, specific, turning = plant.physics.accelerations(
            0.0, plant._state, speeds, [0.0] * 4, 0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        )
        accelerations.append((np.array(specific), np.array(turning)))
    force = FRAME.mass * (accelerations[1][0] - accelerations[0][0])
    moment = inertia @ (accelerations[1][1] - accelerations[0][1])
    power = force @ np.array([3.0, -2.0, 1.0]) + moment @ np.array([2.0, 0.5, 3.0])
    assert power < -1e-4


def test_positive_flapping_lifts_the_nose_in_forward_flight():
    plant = Quadrotor(replace(FRAME, products=(0.0, 0.0, 0.0)), [BladeFlapping(k_flap=1e-6)])
    plant.reset(0, velocity=(4.0, 0.0, 0.0))
    plant.step([FRAME.hover_speed] * 4, 0.01)
    assert plant.measure()["q"] < 0


def test_an_imu_off_the_centre_of_mass_feels_the_centripetal_acceleration():
    frame = replace(
        FRAME, imu_position=(0.1, 0.0, 0.0), products=(0.0, 0.0, 0.0), torque=(0.0, 0.0, 0.0)
    )
    plant = Quadrotor(frame)
    plant.reset(0, rates=(0.0, 0.0, 5.0))
    assert plant.measure()["ax"] == pytest.approx(-0.1 * 25.0)


def test_pose_is_that_of_the_body_origin_not_of_the_centre_of_mass():
    plant = Quadrotor(FRAME, [CenterOfMassOffset(c_x=0.02)])
    plant.reset(0, position=(0.0, 0.0, 1.0), rates=(0.0, 0.0, 3.0))
    seen = plant.measure()
    assert seen["x"] == pytest.approx(-0.02)
    assert seen["vy"] == pytest.approx(-0.06)


def test_a_forward_centre_of_mass_pitches_the_nose_down_under_equal_thrust():
    """The rear rotors get the longer arm, so the nose drops: positive q."""
    plant = Quadrotor(FRAME, [CenterOfMassOffset(c_x=0.01)])
    plant.step([0.5] * 4, 0.01)
    assert plant.measure()["q"] > 0


def test_halving_the_internal_step_changes_nothing_that_a_sensor_could_see():
    ends = []
    for substep in (0.005, 0.0025, 0.00125):
        plant = Quadrotor(FRAME, [RotorDrag(k_x=1e-4, k_y=1e-4)], substep=substep)
        plant.reset(0, rates=(3.0, -4.0, 2.0), velocity=(1.0, 2.0, 0.0))
        for k in range(100):
            plant.step([0.5 + 0.1 * np.sin(k), 0.55, 0.5, 0.52 + 0.05 * np.cos(k)], 0.01)
        ends.append(pick(plant.states(), "x y z vx vy vz qw qx qy qz p q r"))
    coarse, fine = np.max(np.abs(ends[0] - ends[1])), np.max(np.abs(ends[1] - ends[2]))
    assert coarse < 1e-4
    assert 12.0 < coarse / fine < 20.0, "fourth order: the error falls sixteenfold"
