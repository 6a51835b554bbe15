"""A vehicle comes back exactly from its plain values; an error names the key; exact numbers and
priors are told apart."""

from __future__ import annotations

import copy
import json
import pickle
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from greybox.errors import GreyboxError, VehicleError
from greybox.examples import SETS, vehicle_path
from greybox.model.plausibility import vehicle_findings
from greybox.model.vehicle import Vehicle, read_vehicle
from greybox.model.vehicle_parts import Quantity

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
    "actuator": {
        "thrust": [0.0, 0.0, 0.15],
        "thrust_sigma": [0.0, 0.0, 0.02],
        "torque": [0.0, 0.0, 0.001],
    },
    "effects": {"motor_lag": {"tau": {"value": 0.03, "sigma": 0.01}}},
    "battery": {"nominal_voltage": 3.7},
    "noise": {"gyro": 0.02},
    "columns": {
        "rate": {"fields": ["gyro_x", "-gyro_y", "gyro_z"], "unit": "deg/s"},
        "velocity": {"fields": ["vx", "vy", "vz"], "causal": False},
        "specific_force": {
            "fields": ["ax", "ay", "acc"],
            "scale": [1.0, 1.0, -9.81],
            "offset": 0.1,
        },
    },
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
    assert vehicle.columns.sources["rate"].fields == ("gyro_x", "-gyro_y", "gyro_z")
    assert not vehicle.columns.sources["velocity"].causal
    assert vehicle.columns.sources["specific_force"].scale == (1.0, 1.0, -9.81)
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
    plain["columns"]["velocity"]["fields"][1] = "gyro_x"
    with pytest.raises(VehicleError, match="given to two channels"):
        Vehicle.from_dict(plain)


JUNK = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3)
    ),
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


BARE = {
    "schema": "greybox.vehicle/2",
    "mass": 0.5,
    "inertia": [[1.4e-3, 0.0, 0.0], [0.0, 1.5e-3, 0.0], [0.0, 0.0, 2.2e-3]],
    "rotor": [
        {"position": [0.09, -0.12, 0.0], "spin": 1},
        {"position": [-0.09, -0.12, 0.0], "spin": -1},
        {"position": [-0.09, 0.12, 0.0], "spin": 1},
        {"position": [0.09, 0.12, 0.0], "spin": -1},
    ],
    "actuator": {"thrust": [0.0, 0.0, 4.0], "torque": [0.0, 0.0, 0.05]},
    "effects": {
        "motor_lag": {"tau": 0.03},
        "rotor_drag": {"k_x": 0.0, "k_y": {"value": 1e-5, "sigma": 0.0}},
    },
}


def test_a_bare_number_is_believed_within_the_default_of_its_quantity():
    vehicle = Vehicle.from_dict(BARE)
    sigma = {name: q.sigma for name, q in vehicle.quantities.items()}
    assert sigma["mass"] == pytest.approx(0.01 * 0.5)
    assert sigma["inertia.yy"] == pytest.approx(0.3 * 1.5e-3)
    assert sigma["thrust.c2"] == pytest.approx(0.2 * 4.0)
    assert sigma["torque.c2"] == pytest.approx(0.3 * 0.05)
    assert sigma["center_of_mass.z"] == pytest.approx(0.03 * 0.15)  # of the arm
    assert vehicle.effects["motor_lag"]["tau"].sigma == pytest.approx(0.015)
    for exact in ("thrust.c0", "thrust.c1", "torque.c0"):
        assert vehicle.quantities[exact].exact
    assert vehicle.effects["rotor_drag"]["k_x"].exact and vehicle.effects["rotor_drag"]["k_y"].exact


def test_beliefs_say_of_every_number_where_its_sigma_comes_from():
    plain = copy.deepcopy(BARE)
    plain["mass"] = {"value": 0.5, "sigma": 0.002}
    plain["inertia_sigma"] = [0.0, 0.0, 0.0]
    told = {b.quantity: b for b in Vehicle.from_dict(plain).beliefs.entries}
    assert (told["mass"].why, told["mass"].sigma) == ("stated", 0.002)
    assert told["inertia.xx"].why == "exact"
    assert (told["thrust.c2"].why, told["arm"].why) == ("default", "default")
    assert told["arm"].sigma == pytest.approx(0.02 * 0.15)
    lines = Vehicle.from_dict(plain).beliefs.lines()
    assert "mass 0.5 +- 0.002 kg (stated)" in lines
    assert "thrust.c2 4 +- 0.8 N (default, 20%)" in lines
    assert not any(line.startswith("inertia") for line in lines)
    assert "thrust 20%" in Vehicle.from_dict(plain).beliefs.sentence()


def test_files_of_schema_one_keep_bare_numbers_exact():
    old = Vehicle.from_dict(BARE | {"schema": "greybox.vehicle/1"})
    assert all(q.exact for q in old.quantities.values())
    assert {b.why for b in old.beliefs.entries} == {"exact"} and old.beliefs.sentence() == ""
    assert old.to_dict()["mass"] == 0.5 and old.to_dict()["schema"] == "greybox.vehicle/1"
    with pytest.raises(GreyboxError, match="default_sigma"):
        Vehicle.from_dict(BARE | {"schema": "greybox.vehicle/1", "default_sigma": ["mass"]})


def test_what_was_believed_by_default_comes_back_as_that():
    vehicle = Vehicle.from_dict(BARE)
    again = Vehicle.from_dict(json.loads(json.dumps(vehicle.to_dict())))
    assert (
        again == vehicle
        and again.beliefs == vehicle.beliefs
        and pickle.loads(pickle.dumps(vehicle)) == vehicle
    )
    with pytest.raises(GreyboxError, match="did you mean mass"):
        Vehicle.from_dict(BARE | {"default_sigma": ["mas"]})


def test_a_stated_sigma_that_covers_a_body_lets_its_moments_pass_with_a_warning():
    plain = copy.deepcopy(BARE)
    xx, yy = plain["inertia"][0][0], plain["inertia"][1][1]
    plain["inertia"][2][2] = 1.5 * (xx + yy)  # .45 (xx + yy) beyond the 5 %
    for share, readable in ((0.24, True), (0.21, False)):
        plain["inertia_sigma"] = [0.0, 0.0, share * (xx + yy)]
        if readable:
            found = [
                f for f in vehicle_findings(Vehicle.from_dict(plain)) if "triangle" in f.message
            ]
            assert [f.severity for f in found] == ["warning"]
        else:
            with pytest.raises(VehicleError, match=r"no body .* 2 stated sigma"):
                Vehicle.from_dict(plain)


def test_moments_that_no_body_has_block_a_vehicle_that_no_reader_saw():
    vehicle = Vehicle.from_dict(BARE)
    xx, yy = vehicle.inertia[0][0], vehicle.inertia[1][1]
    wrong = replace(vehicle, inertia=((xx, 0.0, 0.0), (0.0, yy, 0.0), (0.0, 0.0, 1.3 * (xx + yy))))
    found = [f for f in vehicle_findings(wrong) if "triangle" in f.message]
    assert [f.severity for f in found] == ["blocking"]


def test_a_guessed_moment_that_no_body_has_is_refused_however_wide_its_default():
    plain = copy.deepcopy(BARE)
    plain["inertia"][2][2] = 4e-3
    with pytest.raises(VehicleError, match="no body has the principal moments"):
        Vehicle.from_dict(plain)
