"""A simulated flight written to disk is a flight log and a vehicle file as the file contract has
them."""

from __future__ import annotations

import csv
import tomllib

import numpy as np
import pytest

from greybox.excitation import Hover
from greybox.plants.effects import MotorLag, RotorDrag
from greybox.plants.flight_log import fly, member, write_log
from greybox.plants.presets import controller_for, nano
from greybox.plants.vehicle_file import write_vehicle

COLUMNS = [
    *("t", "u1", "u2", "u3", "u4", "vbat", "qw", "qx", "qy", "qz", "p", "q", "r", "ax", "ay", "az"),
    *("x", "y", "z", "vx", "vy", "vz", "omega1", "omega2", "omega3", "omega4"),
]


@pytest.fixture(scope="module")
def plant():
    return nano([MotorLag(tau=0.03), RotorDrag(k_x=1e-6, k_y=1e-6)])


@pytest.fixture(scope="module")
def log(plant):
    return fly(plant, controller_for(plant), Hover(), None, 0.5, seed=1, record=("truth",))


def test_a_log_survives_the_file_bit_by_bit(log, tmp_path):
    path = write_log(tmp_path / "flight.csv", log)
    with path.open() as file:
        rows = list(csv.reader(file))
    assert rows[0] == COLUMNS
    assert np.array_equal(
        np.array(rows[1:], dtype=float), np.stack([log[c] for c in COLUMNS], axis=-1)
    )
    assert len(rows) == 51


def test_missing_values_are_empty_cells_and_columns_can_be_left_out(log, tmp_path):
    holed = dict(log, ax=np.where(log["t"] > 0.1, np.nan, log["ax"]))
    path = write_log(tmp_path / "flight.csv", holed, drop=["omega", "vbat"])
    with path.open() as file:
        rows = list(csv.DictReader(file))
    assert set(rows[0]) == {c for c in COLUMNS if not c.startswith("omega") and c != "vbat"}
    assert rows[-1]["ax"] == ""


def test_truth_stays_out_of_the_file_unless_asked_for(log, tmp_path):
    assert "true.nu1" in log
    path = write_log(tmp_path / "flight.csv", log, truth=True)
    assert "true.nu1" in path.read_text().splitlines()[0]


def test_a_row_holds_the_measurement_at_t_k_and_the_command_that_begins_there(plant, log):
    """The rotor speed one sample later is on its way to the command of the row."""
    tau, dt = 0.03, 0.01
    u, nu = log["u1"], log["true.nu1"]
    assert nu[1:] == pytest.approx(u[:-1] + (nu[:-1] - u[:-1]) * np.exp(-dt / tau), abs=1e-12)


def test_a_batch_is_written_member_by_member(tmp_path):
    plant = nano()
    batch = fly(plant, controller_for(plant), Hover(), None, 0.1, seed=[1, 2])
    with pytest.raises(ValueError, match="member"):
        write_log(tmp_path / "flight.csv", batch)
    write_log(tmp_path / "flight.csv", member(batch, 1))


def test_the_vehicle_file_states_nominal_values_with_their_sigma(plant, tmp_path):
    path = write_vehicle(
        tmp_path / "vehicle.toml",
        plant,
        errors={"inertia": 1.15, "inertia.zz": 0.9, "thrust": 0.85},
        sigma={"mass": 0.01, "inertia": 0.2, "thrust": 0.2},
        known=["motor_lag"],
    )
    told = tomllib.loads(path.read_text())
    frame = plant.airframe
    assert told["schema"] == "greybox.vehicle/1"
    assert told["mass"] == {"value": frame.mass, "sigma": pytest.approx(0.01 * frame.mass)}
    assert np.diag(told["inertia"]) == pytest.approx(np.array(frame.inertia) * [1.15, 1.15, 0.9])
    assert told["inertia_sigma"] == pytest.approx(0.2 * np.diag(told["inertia"]))
    assert told["actuator"]["thrust"][2] == pytest.approx(0.85 * frame.thrust[2])
    assert told["actuator"]["torque_sigma"] == [0, 0, 0]
    assert told["effects"] == {"motor_lag": {"tau": 0.03}}
    assert [r["spin"] for r in told["rotor"]] == [1, -1, 1, -1]
    assert told["noise"]["gyro"] == plant.sensors.gyro


def test_a_misspelt_key_is_refused(plant, tmp_path):
    with pytest.raises(ValueError, match="inertiae"):
        write_vehicle(tmp_path / "v.toml", plant, errors={"inertiae": 1.1})
    with pytest.raises(ValueError, match="wobble"):
        write_vehicle(tmp_path / "v.toml", plant, known=["wobble"])
    assert not (tmp_path / "v.toml").exists()
