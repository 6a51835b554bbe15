"""Rungs of the ladder of fits lack what they say, and intervals of errors know their blocks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greybox.validation.horizon_table import GroupErrors, HorizonTable
from scenarios.studies.fit_ladder import HELD, MOTORS, Recipe, recipe_of, without
from scenarios.studies.nanobench import interval

OPTIONS = [
    "--manual",
    *("--effects", "motor_lag,rotor_drag,gyro_bias,mocap_misalignment", "--kinematic-noise"),
    *("--disturbance", "force,torque", "--predictor", "multi-step", "--fixed", "mass"),
    *("--per-flight", "mocap_misalignment.theta_x"),
    *("--value", "inertia.xx=1e-05,rotor_drag.k_x=0.1,motor_lag.tau=0.05,disturbance.torque.T=0.2"),
    *("--noise", "process.torque.x=1e-05,process.disturbance.torque.x=1e-06,sensor.p=0.1"),
]


@pytest.fixture
def recipe() -> Recipe:
    return recipe_of(OPTIONS)


def test_options_are_read_in_pairs(recipe: Recipe) -> None:
    assert recipe["--manual"] is None and recipe["--kinematic-noise"] is None
    assert recipe["--fixed"] == "mass" and recipe["--predictor"] == "multi-step"


def test_motors_alone_know_no_air_no_flight_and_no_push(recipe: Recipe) -> None:
    found = without(recipe, "motors")
    assert found["--effects"] == ",".join(MOTORS) and found["--disturbance"] == "none"
    assert found["--value"] == "inertia.xx=1e-05,motor_lag.tau=0.05"
    assert found["--noise"] == "process.torque.x=1e-05,sensor.p=0.1"
    assert "--per-flight" not in found and found["--predictor"] == "innovation"


def test_effects_keep_what_belongs_to_a_flight_and_no_push(recipe: Recipe) -> None:
    found = without(recipe, "effects")
    assert found["--effects"] == recipe["--effects"]
    assert found["--per-flight"] == recipe["--per-flight"]
    assert found["--value"] == "inertia.xx=1e-05,rotor_drag.k_x=0.1,motor_lag.tau=0.05"


def test_a_held_time_scale_is_held_at_its_number(recipe: Recipe) -> None:
    found = without(recipe, "held")
    assert found["--fixed"] == "mass,disturbance.force.T,disturbance.torque.T"
    assert f"disturbance.torque.T={HELD:g}" in str(found["--value"])
    assert "disturbance.torque.T=0.2" not in str(found["--value"])
    assert without(recipe, "likelihood") == {**recipe, "--predictor": "innovation"}


def test_intervals_are_those_of_blocks_and_flights() -> None:
    """Four flights of a thousand blocks each: only what differs between flights is left."""
    sums = np.random.default_rng(1).normal(1.0, 0.1, size=(1000, 1))
    one = GroupErrors(
        mae=np.ones(1),
        rmse=np.ones(1),
        n=np.ones(1, dtype=np.int64),
        diverged=np.zeros(1, dtype=np.int64),
        origins=1,
        left_out=0,
        block_sums=sums,
        block_counts=np.ones((1000, 1)),
    )
    alike = {f"f{k}": {"rate": one} for k in range(4)}
    table = HorizonTable(
        label="model", sample_time=0.01, required=1, groups={"rate": one}, flights=alike
    )
    low, high = interval(table, "rate", 1)
    assert sums.mean() - 0.01 < low < sums.mean() < high < sums.mean() + 0.01
    uneven = {f: {"rate": replace(one, block_sums=k * sums)} for k, f in enumerate(alike)}
    low, high = interval(replace(table, flights=uneven), "rate", 1)
    assert low < 0.6 and high > 2.4
