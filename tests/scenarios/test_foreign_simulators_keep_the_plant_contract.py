"""RotorPy, MuJoCo, drone-models and PyBullet are plants: frames, signs, sensors, seeds as in the
contract."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greybox.plants.battery import Battery
from greybox.plants.noise import SensorNoise
from scenarios.foreign.craft import Air
from tests.foreign_plants import ALL, CRAFT, FOREIGN, FRAME, GRAVITY, HOVER, OFFSET, WINDY, make

COLUMNS = [
    *("t", "u1", "u2", "u3", "u4", "qw", "qx", "qy", "qz", "p", "q", "r", "ax", "ay", "az"),
    *("x", "y", "z", "vx", "vy", "vz", "omega1", "omega2", "omega3", "omega4"),
]
ARMS = np.array([rotor.position for rotor in FRAME.rotors])
SPINS = np.array([rotor.spin for rotor in FRAME.rotors])
ROUGH = {"pybullet": 15.0}
"""By this factor tolerances are wider where gyroscopic moments are integrated to first order
only."""


def wiggle(k: int) -> list[float]:
    """Commands about hover that move every axis."""
    t = 0.01 * k
    roll, pitch, yaw = 0.03 * np.sin(9.0 * t), 0.03 * np.sin(7.0 * t + 1.0), 0.05 * np.sin(5.0 * t)
    mix = -np.sign(ARMS[:, 1]) * -roll - np.sign(ARMS[:, 0]) * pitch - SPINS * yaw
    return (HOVER + 0.02 * np.sin(3.0 * t) + mix).tolist()


def states(plant, steps=60, **start):
    plant.reset(1, **start)
    for k in range(steps):
        plant.step(wiggle(k), 0.01)
    return plant.states()


@pytest.mark.parametrize("simulator", FOREIGN)
def test_a_measurement_has_the_columns_of_a_flight_log(simulator):
    plant = make(simulator)
    assert list(plant.measure()) == COLUMNS
    assert plant.measure([0.1, 0.2, 0.3, 0.4])["u3"] == 0.3


@pytest.mark.parametrize("simulator", FOREIGN)
def test_hover_command_hovers_and_the_accelerometer_feels_gravity_upwards(simulator):
    plant = make(simulator)
    plant.reset(3)
    for _ in range(100):
        plant.step([HOVER] * 4, 0.01)
    seen = plant.measure()
    assert [seen[c] for c in ("x", "y", "z")] == pytest.approx([0.0, 0.0, 1.0], abs=1e-6)
    assert [seen[c] for c in ("qw", "p", "q", "r")] == pytest.approx([1.0, 0.0, 0.0, 0.0], abs=1e-6)
    assert [seen[c] for c in ("ax", "ay", "az")] == pytest.approx([0.0, 0.0, GRAVITY], abs=1e-6)
    assert seen["omega1"] == pytest.approx(2300.0 * HOVER)


@pytest.mark.parametrize("simulator", FOREIGN)
@pytest.mark.parametrize("rotor", range(4))
def test_one_faster_rotor_turns_the_craft_as_its_place_and_spin_say(simulator, rotor):
    """The change of the rates in 4 ms is the integral of the moment, J^-1 (r x T e_z - s Q e_z)."""
    plant = make(simulator)
    plant.reset(0)
    command, duration = np.full(4, HOVER), 0.004
    command[rotor] += 0.1
    plant.step(command, duration)
    times = (np.arange(400) + 0.5) * duration / 400
    nu = HOVER + 0.1 * (1.0 - np.exp(-times / CRAFT.lag))
    more_thrust = np.mean(4.2 * (nu**2 - HOVER**2)) * duration
    more_torque = np.mean(0.055 * (nu**2 - HOVER**2)) * duration
    x, y, _ = ARMS[rotor]
    moment = np.array([y * more_thrust, -x * more_thrust, -SPINS[rotor] * more_torque])
    states = plant.states()
    assert [states[c] for c in "pqr"] == pytest.approx(moment / FRAME.inertia, rel=1e-3)
    assert states["vz"] == pytest.approx(more_thrust / FRAME.mass, rel=1e-3)


@pytest.mark.parametrize("simulator", FOREIGN)
@pytest.mark.parametrize(
    "craft",
    [
        CRAFT,
        replace(CRAFT, airframe=OFFSET),
        replace(CRAFT, delay=0.013),
        replace(CRAFT, airframe=replace(FRAME, products=(1e-4, -2e-4, 1.5e-4))),
        replace(CRAFT, uneven=(0.05, -0.03, 0.02, -0.04)),
        replace(
            CRAFT,
            airframe=replace(FRAME, nominal_voltage=11.1),
            battery=Battery(
                full=12.4, empty=10.0, capacity=50.0, resistance=0.03, full_current=40.0
            ),
            sag=0.8,
        ),
    ],
    ids=["plain", "offset", "delay", "products", "uneven", "battery"],
)
def test_every_simulator_flies_the_same_body_as_our_own_plants_do(simulator, craft):
    """Without air the laws are the same: 0.6 s of open-loop wiggling ends in one place."""
    ours, theirs = states(make("plants", craft)), states(make(simulator, craft))
    for name in (
        "x",
        "y",
        "z",
        "vx",
        "vy",
        "vz",
        "qw",
        "qx",
        "qy",
        "qz",
        "p",
        "q",
        "r",
        "nu1",
        "nu4",
    ):
        assert theirs[name] == pytest.approx(ours[name], abs=1e-4 * ROUGH.get(simulator, 1.0)), name
    assert abs(ours["p"]) + abs(ours["q"]) > 0.2


@pytest.mark.parametrize("simulator", FOREIGN)
def test_sensors_away_from_the_centre_of_mass_read_what_our_own_plants_read(simulator):
    craft = replace(CRAFT, airframe=OFFSET)
    ours, theirs = make("plants", craft), make(simulator, craft)
    states(ours), states(theirs)
    want, got = ours.measure(), theirs.measure()
    for name in ("ax", "ay", "az", "x", "y", "z", "vx", "vy", "vz", "p", "q", "r"):
        assert got[name] == pytest.approx(want[name], abs=1e-3 * ROUGH.get(simulator, 1.0)), name


def test_the_accelerometer_agrees_with_the_one_that_mujoco_has():
    plant = make("mujoco", replace(CRAFT, airframe=OFFSET, air=WINDY))
    states(plant)
    seen = plant.measure(noise=False)
    felt, rates = plant.own_sensors()
    assert [seen[c] for c in ("ax", "ay", "az")] == pytest.approx(felt, abs=1e-9)
    assert [seen[c] for c in "pqr"] == pytest.approx(rates, abs=1e-9)


@pytest.mark.parametrize("simulator", FOREIGN)
def test_a_tumbling_body_without_thrust_keeps_energy_spin_and_unit_quaternion(simulator):
    plant = make(simulator, replace(CRAFT, lag=0.015))
    plant.reset(0, velocity=(1.0, -2.0, 3.0), rates=(3.0, -2.0, 4.0), attitude=(0.8, 0.6, 0.0, 0.0))
    for _ in range(30):  # 20 time constants: the rotors stand still
        plant.step([0.0] * 4, 0.01)

    def spin():
        found = plant.states()
        w, x, y, z = (found[c] for c in ("qw", "qx", "qy", "qz"))
        axis, momentum = np.array([x, y, z]), np.array(FRAME.inertia) * [found[c] for c in "pqr"]
        across = 2.0 * np.cross(axis, momentum)
        return momentum + w * across + np.cross(axis, across), w * w + axis @ axis

    energy, (momentum, _) = plant.energy(), spin()
    for _ in range(100):
        plant.step([0.0] * 4, 0.01)
    later, length = spin()
    rough = ROUGH.get(simulator, 1.0)
    assert plant.energy() == pytest.approx(energy, rel=1e-4 * rough)
    small = 1e-8 if rough == 1.0 else 1e-4 * rough * float(np.linalg.norm(momentum))
    assert later == pytest.approx(momentum, rel=1e-4, abs=small)
    assert length == pytest.approx(1.0, abs=1e-9)


def deceleration(plant, speed):
    plant.reset(0, velocity=(speed, 0.0, 0.0))
    return plant.measure(noise=False)["ax"]


def test_drag_has_the_size_that_the_truth_says_where_it_is_exact():
    plant = make("rotorpy", replace(CRAFT, air=replace(WINDY, gusts=0.0, swirl=0.0)))
    named = plant.truth()["parameters"]
    want = 4.0 * named["rotor_drag.k_x"] * 2300.0 * HOVER * 3.0 + named["parasitic_drag.c_x"] * 9.0
    assert deceleration(plant, 3.0) == pytest.approx(-want / FRAME.mass, rel=1e-9)


def test_drag_has_the_size_that_the_truth_says_where_it_comes_near():
    air = replace(WINDY, gusts=0.0, swirl=0.0)
    plant = make("mujoco", replace(CRAFT, air=air))
    want = plant.truth()["near"]["parasitic_drag.c_x"] * 9.0 / FRAME.mass
    assert deceleration(plant, 3.0) == pytest.approx(-want, rel=1e-6)
    plant = make("drone_models", replace(CRAFT, air=air))
    want = 4.0 * plant.truth()["near"]["rotor_drag.k_x"] * 2300.0 * HOVER * 3.0 / FRAME.mass
    assert deceleration(plant, 3.0) == pytest.approx(-want, rel=1e-6)


@pytest.mark.parametrize("simulator", FOREIGN)
def test_wind_pushes_as_flying_against_it_does(simulator):
    air = Air(rotor_drag=2e-5, inflow=0.0, parasitic=(1e-3, 1e-3, 2e-3))
    still, windy = (
        make(simulator, replace(CRAFT, air=a)) for a in (air, replace(air, wind=(-3.0, 0.0, 0.0)))
    )
    assert deceleration(windy, 0.0) == pytest.approx(deceleration(still, 3.0), rel=1e-6)
    assert deceleration(windy, 0.0) < -0.01


@pytest.mark.parametrize("simulator", FOREIGN)
def test_a_seed_repeats_a_flight_and_another_seed_does_not(simulator):
    plant = make(
        simulator, replace(CRAFT, air=WINDY), sensors=SensorNoise(gyro=0.01, attitude=0.002)
    )

    def rows(seed):
        plant.reset(seed)
        found = []
        for k in range(20):
            found.append(list(plant.measure(wiggle(k)).values()))
            plant.step(wiggle(k), 0.01)
        return np.array(found)

    first = rows(5)
    assert np.array_equal(first, rows(5))
    assert not np.array_equal(first, rows(6))


@pytest.mark.parametrize("simulator", FOREIGN)
def test_gusts_move_the_craft_and_noise_does_not(simulator):
    calm, noisy = make(simulator), make(simulator, sensors=SensorNoise(position=0.1))
    assert states(calm) == pytest.approx(states(noisy), nan_ok=True)
    assert abs(states(make(simulator, replace(CRAFT, air=WINDY)))["vx"] - states(calm)["vx"]) > 1e-3


def test_rotors_of_a_fitted_crazyflie_rise_and_fall_at_different_speeds():
    plant = make("drone_models", fitted="cf21B_500")
    plant.reset(0)
    plant.step([HOVER + 0.1] * 4, 0.02)
    up = plant.states()["nu1"] - HOVER
    plant.reset(0)
    plant.step([HOVER - 0.1] * 4, 0.02)
    down = HOVER - plant.states()["nu1"]
    first_order = 0.1 * (1.0 - np.exp(-0.02 / CRAFT.lag))
    assert 0.5 * (up + down) == pytest.approx(first_order, rel=0.1)
    assert abs(up - down) > 0.02 * first_order
    assert "motor_lag.tau" in plant.truth()["near"]
    assert "motor_lag.tau" not in plant.truth()["parameters"]


def test_what_a_simulator_cannot_fly_is_refused_with_the_reason():
    pytest.importorskip("rotorpy", reason="RotorPy comes with the extra judge")
    with pytest.raises(ValueError, match="c0 and c1"):
        make("rotorpy", replace(CRAFT, airframe=replace(FRAME, thrust=(0.0, 0.1, 4.0))))
    with pytest.raises(ValueError, match="gravity"):
        make("rotorpy", replace(CRAFT, airframe=replace(FRAME, gravity=9.80665)))


def test_a_plant_says_how_many_commands_and_seeds_it_takes():
    plant = make("mujoco")
    with pytest.raises(ValueError, match="4 rotors"):
        plant.step([0.5] * 3)
    with pytest.raises(ValueError, match="one seed"):
        plant.reset([1, 2])


def test_a_craft_needs_a_lag():
    with pytest.raises(ValueError, match="lag"):
        replace(CRAFT, lag=0.0)
    assert len(ALL) == 5
