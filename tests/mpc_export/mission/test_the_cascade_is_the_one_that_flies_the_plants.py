"""The cascade of the missions, written on a vehicle file, commands what the one that flies the
plants commands."""

from __future__ import annotations

import numpy as np
import pytest

from greybox.model.vehicle import read_vehicle
from greybox.plants.controller import CascadeController as PlantController
from greybox.plants.controller import Setpoint
from greybox.plants.presets import nano, x250
from greybox.plants.vehicle_file import write_vehicle
from mpc_export.mission import OBSTACLE_COURSE
from mpc_export.mission.cascade import CascadeController


@pytest.mark.parametrize("make", [nano, x250])
def test_the_same_commands_in_any_state(make, tmp_path) -> None:
    plant = make()
    vehicle = read_vehicle(write_vehicle(tmp_path / "v.toml", plant))
    ours, theirs = CascadeController(vehicle), PlantController(plant.airframe)
    assert ours.hover == pytest.approx(float(np.mean(plant.airframe.hover_speed)), rel=1e-9)
    rng = np.random.default_rng(3)
    for k in range(60):
        q = rng.normal(size=4) * (0.3, 0.1, 0.1, 0.3) + (1.0, 0.0, 0.0, 0.0)
        q /= np.linalg.norm(q)
        seen = dict(zip(("qw", "qx", "qy", "qz"), map(float, q)))
        seen |= dict(
            zip(("x", "y", "z", "vx", "vy", "vz", "p", "q", "r"), rng.normal(size=9).tolist())
        )
        goal = OBSTACLE_COURSE.sample(np.array([0.1 * k]))
        setpoint = Setpoint(
            position=tuple(goal.position[0]),
            velocity=tuple(goal.velocity[0]),
            acceleration=tuple(goal.acceleration[0]),
            yaw=float(goal.yaw[0]),
            yaw_rate=float(goal.yaw_rate[0]),
        )
        np.testing.assert_allclose(
            ours(seen, goal, 0.01),
            theirs(seen, setpoint, 0.01, (0.0, 0.0, 0.0, 0.0)),
            rtol=1e-8,
            atol=1e-10,
        )
