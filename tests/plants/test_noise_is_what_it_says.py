"""Noise has the stated levels, reaches what it should reach, and repeats with its seed, alone or in
a batch."""

from __future__ import annotations

import numpy as np
import pytest

from greybox.excitation import RandomWaypoints, rich_excitation
from greybox.plants.airframe import Airframe, x_layout
from greybox.plants.effects import BatterySag, CommandDelay, MotorLag, RotorDrag
from greybox.plants.flight_log import FEW, fly, member
from greybox.plants.noise import ProcessNoise, SensorNoise
from greybox.plants.presets import controller_for, nano
from greybox.plants.quadrotor import Quadrotor

FRAME = Airframe(
    name="test",
    mass=0.5,
    inertia=(2.1e-3, 2.9e-3, 3.9e-3),
    rotors=x_layout(0.09, 0.08),
    thrust=(0.0, 0.0, 4.2),
    torque=(0.0, 0.0, 0.055),
)


def one_step(plant, seeds):
    plant.reset(seeds)
    before = plant.measure()
    plant.step(np.full((len(seeds), 4), FRAME.hover_speed), 0.01)
    return before, plant.measure()


def test_force_noise_kicks_velocity_by_the_spectral_level_and_is_felt_by_the_accelerometer():
    q = 0.02
    before, after = one_step(Quadrotor(FRAME, process=ProcessNoise(force=q)), range(3000))
    kick = after["vx"] / 0.01
    assert np.std(kick) == pytest.approx(q / np.sqrt(0.01) / 0.5, rel=0.05)
    assert kick == pytest.approx(before["ax"], abs=1e-9), (
        "the accelerometer at t_k sees the force that begins at t_k"
    )
    assert np.std(after["ax"]) == pytest.approx(q / np.sqrt(0.01) / 0.5, rel=0.05)
    assert abs(np.corrcoef(before["ax"], after["ax"])[0, 1]) < 0.06


def test_torque_noise_kicks_the_rates_by_the_spectral_level():
    q = (1e-4, 2e-4, 3e-4)
    _, after = one_step(Quadrotor(FRAME, process=ProcessNoise(torque=q)), range(4000))
    for name, level, inertia in zip("pqr", q, FRAME.inertia):
        assert np.std(after[name]) == pytest.approx(level * np.sqrt(0.01) / inertia, rel=0.05)


def test_variance_of_the_velocity_does_not_depend_on_the_sample_time():
    spreads = []
    for dt in (0.005, 0.02):
        plant = Quadrotor(FRAME, process=ProcessNoise(force=0.02), sample_time=dt)
        plant.reset(range(3000))
        for _ in range(round(0.1 / dt)):
            plant.step(np.full((3000, 4), FRAME.hover_speed), dt)
        spreads.append(np.std(plant.measure()["vy"]))
    assert spreads[0] == pytest.approx(spreads[1], rel=0.08)
    assert spreads[0] == pytest.approx(0.02 * np.sqrt(0.1) / 0.5, rel=0.06)


def test_a_drifting_force_walks_and_a_bounded_one_settles():
    walk = Quadrotor(FRAME, process=ProcessNoise(drift_force=0.1))
    bound = Quadrotor(FRAME, process=ProcessNoise(drift_force=0.1, drift_time=0.1))
    spread = []
    for plant in (walk, bound):
        plant.reset(range(1200))
        for _ in range(99):
            plant.step(np.full((1200, 4), FRAME.hover_speed), 0.01)
        spread.append(np.std(plant.states()["force_x"]))
    assert spread[0] == pytest.approx(0.1, rel=0.08)
    assert spread[1] == pytest.approx(0.1 * np.sqrt(0.1 / 2), rel=0.08)


def test_sensor_noise_has_the_stated_levels():
    sensors = SensorNoise(
        gyro=0.02, accelerometer=0.1, attitude=0.003, position=0.004, velocity=0.05
    )
    plant = Quadrotor(FRAME, sensors=sensors)
    plant.reset(range(4000))
    seen = plant.measure()
    levels = {"p": 0.02, "ay": 0.1, "qx": 0.0015, "qz": 0.0015, "z": 0.004, "vx": 0.05}
    for name, level in levels.items():
        assert np.std(seen[name]) == pytest.approx(level, rel=0.06), name


def test_measuring_twice_gives_the_same_noise():
    plant = nano()
    assert plant.measure() == plant.measure()


EFFECTS = (
    MotorLag(tau=0.03),
    CommandDelay(d=0.013),
    RotorDrag(k_x=1e-6, k_y=1e-6),
    BatterySag(nominal_voltage=3.8, c_V=1.0),
)


def closed_loop(seed):
    plant = nano(EFFECTS)
    return fly(plant, controller_for(plant), RandomWaypoints(), rich_excitation(), 1.5, seed=seed)


def test_the_same_seed_gives_the_same_flight_and_another_seed_another():
    first, again, other = closed_loop(5), closed_loop(5), closed_loop(6)
    assert all(np.array_equal(first[name], again[name]) for name in first)
    assert np.max(np.abs(first["p"] - other["p"])) > 0.1


def test_a_member_of_a_batch_flies_as_if_alone():
    batch = closed_loop([4, 5, 9, *range(20, 20 + FEW)])
    for index, seed in enumerate((4, 5, 9)):
        alone, inside = closed_loop(seed), member(batch, index)
        assert list(alone) == list(inside)
        for name in alone:
            assert inside[name] == pytest.approx(alone[name], abs=1e-9), name


def test_a_few_are_flown_one_by_one_and_come_as_a_batch():
    few = closed_loop([4, 5])
    for index, seed in enumerate((4, 5)):
        alone, inside = closed_loop(seed), member(few, index)
        assert list(alone) == list(inside) and few["t"].shape == alone["t"].shape
        assert all(np.array_equal(alone[name], inside[name]) for name in alone)


def test_what_differs_between_members_is_flown_as_a_batch():
    noisy = SensorNoise(gyro=np.array([0.0, 0.2]))
    plant = nano(EFFECTS, sensors=noisy)
    assert not plant.alike and nano(EFFECTS).alike
    flown = fly(plant, controller_for(plant), RandomWaypoints(), None, 0.3, seed=[4, 4])
    assert flown["p"].shape == (30, 2)
    assert np.ptp(flown["p"][:3, 0]) < 0.1 * np.ptp(flown["p"][:3, 1])


def test_silencing_one_sensor_leaves_the_noise_of_the_others():
    loud = Quadrotor(FRAME, sensors=SensorNoise(gyro=0.1, position=0.1))
    quiet = Quadrotor(FRAME, sensors=SensorNoise(position=0.1))
    for plant in (loud, quiet):
        plant.reset(8)
    assert loud.measure()["x"] == quiet.measure()["x"]
    assert loud.measure()["p"] != quiet.measure()["p"]


def test_parameters_may_differ_between_the_members_of_a_batch():
    mass = np.array([0.4, 0.5, 0.6])
    frame = Airframe(
        name="three",
        mass=mass,
        inertia=FRAME.inertia,
        rotors=FRAME.rotors,
        thrust=FRAME.thrust,
        torque=FRAME.torque,
    )
    plant = Quadrotor(frame, [MotorLag(tau=np.array([0.0, 0.02, 0.05]))])
    plant.reset([0, 1, 2])
    plant.step(np.full((3, 4), FRAME.hover_speed), 0.01)
    climb = plant.measure()["vz"]
    assert climb[0] > 0.0 > climb[2]
    assert climb[1] == pytest.approx(0.0, abs=1e-9)
