"""A vehicle comes back exactly from its plain values; an error names the key; exact numbers and priors are told apart."""

from __future__ import annotations

import copy
import json
import pickle

import pytest
from hypothesis import given
from hypothesis import strategies as st

from greybox.errors import GreyboxError, VehicleError
from greybox.model.vehicle import Quantity, Vehicle, read_vehicle
from scenarios.flights import SETS, vehicle_path

PLAIN = {
    "schema": "greybox.vehicle/1",
    "name": "made",
    "mass": {"value": 0.03, "sigma": 0.001},
    "inertia": [[1.4e-5, 1e-7, 0.0], [1e-7, 1.5e-5, 0.0], [0.0, 0.0, 2.2e-5]],
    "inertia_sigma": [1e-6, 1e-6, 2e-6],
    "center_of_mass": [0.0, {"value": 0.001, "sigma": 0.0005}, 0.0],
    "rotor": [
        {"position": [0.03, -0.03, 0.0], "spin": 1},
        {"position": [-0.03, -0.03, 0.0], "spin": -1},
        {"position": [-0.03, 0.03, 0.0], "spin": 1},
        {"position": [0.03, 0.03, 0.0], "spin": -1},
    ],
    "actuator": {"thrust": [0.0, 0.0, 0.15], "thrust_sigma": [0.0, 0.0, 0.02], "torque": [0.0, 0.0, 0.001]},
    "effects": {"motor_lag": {"tau": {"value": 0.03, "sigma": 0.01}}},
    "battery": {"nominal_voltage": 3.7},
    "noise": {"gyro": 0.02},
    "columns": {"p": "gyro_x", "vx": {"name": "vx", "causal": False}, "az": {"name": "acc", "scale": -9.81}},
}


@pytest.mark.parametrize("set_name", SETS)
def test_shipped_vehicles_round_trip(set_name):
    vehicle = read_vehicle(vehicle_path(set_name))
    assert Vehicle.from_dict(json.loads(json.dumps(vehicle.to_dict()))) == vehicle
    assert pickle.loads(pickle.dumps(vehicle)) == vehicle
    assert len({vehicle, read_vehicle(vehicle_path(set_name))}) == 1


def test_priors_and_exact_numbers():
    vehicle = Vehicle.from_dict(PLAIN)
    assert Vehicle.from_dict(vehicle.to_dict()) == vehicle
    quantities = vehicle.quantities
    assert quantities["mass"] == Quantity(value=0.03, sigma=0.001)
    assert quantities["inertia.zz"] == Quantity(value=2.2e-5, sigma=2e-6)
    assert quantities["thrust.c2"].sigma == 0.02
    assert quantities["thrust.c1"].exact
    assert quantities["center_of_mass.y"].sigma == 0.0005
    assert vehicle.effects["motor_lag"]["tau"] == Quantity(value=0.03, sigma=0.01)
    assert vehicle.columns["p"].name == "gyro_x"
    assert not vehicle.columns["vx"].causal
    assert vehicle.columns["az"].scale == -9.81
    assert vehicle.gravity == 9.80665
    assert vehicle.actuator.hold == "previous"
    assert vehicle.nominal_voltage == 3.7


def test_from_dict_leaves_its_input_alone():
    before = copy.deepcopy(PLAIN)
    Vehicle.from_dict(PLAIN)
    assert before == PLAIN


def test_the_shipped_priors_hover_at_the_commands_that_were_flown():
    vehicle = read_vehicle(vehicle_path("nanobench"))
    c0, c1, c2 = (q.value for q in vehicle.actuator.thrust)
    thrust = [vehicle.n_rotors * (c0 + c1 * u + c2 * u * u) for u in (0.8, 0.9)]
    assert thrust[0] < vehicle.mass.value * vehicle.gravity < thrust[1]


def test_a_bare_thrust_sigma_given_twice_is_an_error():
    plain = copy.deepcopy(PLAIN)
    plain["actuator"]["thrust"][2] = {"value": 0.15, "sigma": 0.01}
    with pytest.raises(VehicleError, match=r"actuator\.thrust_sigma: sigma given twice"):
        Vehicle.from_dict(plain)


def test_two_channels_from_one_column_is_an_error():
    plain = copy.deepcopy(PLAIN)
    plain["columns"]["q"] = "gyro_x"
    with pytest.raises(VehicleError, match="given to two channels"):
        Vehicle.from_dict(plain)


JUNK = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)


@given(data=st.data(), junk=JUNK)
def test_junk_anywhere_is_a_vehicle_or_one_line(data, junk):
    plain = copy.deepcopy(PLAIN)
    place = plain
    while True:
        keys = sorted(place) if isinstance(place, dict) else list(range(len(place)))
        key = data.draw(st.sampled_from(keys))
        inner = place[key]
        if isinstance(inner, (dict, list)) and inner and data.draw(st.booleans()):
            place = inner
        else:
            place[key] = junk
            break
    vehicle, message = None, None
    try:
        vehicle = Vehicle.from_dict(plain, where="made.toml")
    except GreyboxError as error:
        message = str(error)
    if vehicle is None:
        assert "made.toml" in message
        assert "\n" not in message
    else:
        assert Vehicle.from_dict(vehicle.to_dict()) == vehicle
