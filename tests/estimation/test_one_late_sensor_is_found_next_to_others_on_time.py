"""A gyro that shows its readings part of a sample late, next to sensors on time, is found with how
late it is."""

from __future__ import annotations

import pytest

from greybox.data import dataset_from_arrays
from greybox.estimation.fit import fit
from greybox.excitation.injection import rich_excitation
from greybox.excitation.waypoints import RandomWaypoints
from greybox.model.model import build_model
from greybox.model.noise import Augmented, Delay
from greybox.model.vehicle import read_vehicle
from greybox.plants.flight_log import fly
from greybox.plants.presets import controller_for, x250
from greybox.plants.vehicle_file import write_vehicle

DT, LATE = 0.01, 0.006
COLUMNS = ("p", "q", "r", "ax", "ay", "az", "qw", "qx", "qy", "qz")


@pytest.mark.parametrize("late", [LATE, 0.0])
def test_a_late_gyro_is_found_with_its_delay(tmp_path, late):
    plant = x250()
    log = fly(
        plant, controller_for(plant), RandomWaypoints(), rich_excitation(), 6.0, seed=5, warm_up=1.0
    )
    vehicle = read_vehicle(write_vehicle(tmp_path / "v.toml", plant, sigma={"thrust.c2": 0.1}))
    channels = {k: v.copy() for k, v in log.items() if k in COLUMNS or k[:1] == "u"}
    for name in ("p", "q", "r"):
        channels[name][1:] += late / DT * (channels[name][:-1] - channels[name][1:])
    data = dataset_from_arrays(log["t"], channels)
    physics = build_model(vehicle, data.channels, (), sample_time=DT)
    model = Augmented(core=physics, parts=(Delay(sensor="gyro", time=0.002),))
    found = fit(model, data, free=["thrust.c2", "delay.gyro.d"], initialisation="noise")
    estimate = found.parameters["delay.gyro.d"]
    assert found.converged or estimate.at_bound
    assert estimate.value == pytest.approx(late, abs=5e-4)
