"""A model file keeps every kind of noise part in the order of the model, and earlier files, which
named groups of disturbances, are read as before."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from greybox.errors import GreyboxError, UnknownNameError
from greybox.files import checksum
from greybox.model import identified as identified_module
from greybox.model.identified import IdentifiedModel
from greybox.model.model import build_model
from greybox.model.noise import (
    KINDS,
    Augmented,
    Coloured,
    Delay,
    Disturbance,
    Drift,
    Gust,
    Line,
    LowPass,
    part_named,
    with_disturbance,
)
from greybox.model.parameter import ParameterValues
from greybox.model.vehicle import read_vehicle
from greybox.plants.presets import x250
from greybox.plants.vehicle_file import write_vehicle

COLUMNS = ("p", "q", "r", "ax", "ay", "az", "qw", "qx", "qy", "qz")


@pytest.fixture(scope="module")
def physics(tmp_path_factory):
    vehicle = read_vehicle(write_vehicle(tmp_path_factory.mktemp("v") / "v.toml", x250()))
    return build_model(vehicle, COLUMNS, ("rotor_drag",), sample_time=0.01)


def identified(dynamics):
    return IdentifiedModel(
        dynamics=dynamics,
        values=ParameterValues({d.name: d.nominal for d in dynamics.parameters}),
        process_noise=dynamics.noise_scale(0.01),
        sensor_noise=dynamics.sensor_scale(),
        weak=np.linspace(1.0, 2.0, len(dynamics.error_states)),
        reference_state=dynamics.reference({}),
        reference_inputs=np.full(len(dynamics.inputs), 0.5),
        sample_time=0.01,
    )


def test_a_disturbed_model_comes_back_and_its_file_keeps_its_names(physics, tmp_path):
    model = identified(with_disturbance(physics, ("force", "torque"), time=0.5))
    path = model.save(tmp_path / "model.json")
    body = json.loads(path.read_text())
    assert body["noise_parts"] == [
        {"kind": "disturbance", "group": g, "time": 0.5} for g in ("force", "torque")
    ]
    assert list(body["values"])[-2:] == ["disturbance.force.T", "disturbance.torque.T"]
    assert list(body["process_noise"])[6:] == [
        f"disturbance.{g}.{a}" for g in ("force", "torque") for a in "xyz"
    ]
    assert body["name"] == f"{physics.name}, disturbance force, torque"
    back = IdentifiedModel.load(path)
    assert back.dynamics.states == model.dynamics.states
    assert back.dynamics.parameters == model.dynamics.parameters
    assert back.save(tmp_path / "again.json").read_bytes() == path.read_bytes()


def signed(body):
    body["checksum"] = checksum(
        {k: v for k, v in body.items() if k not in ("checksum", "versions")}
    )
    return body


@pytest.mark.parametrize(
    ("groups", "time"), [([], None), (["force", "torque"], 0.5), (["torque", "force"], 0.5)]
)
def test_a_file_that_names_groups_of_disturbances_is_read_as_before(physics, groups, time):
    """In any order: its numbers are in the order of the process noise all the same."""
    model = identified(with_disturbance(physics, groups, time=time or 1.0))
    body = dict(model.to_dict())
    del body["noise_parts"]
    body |= {"disturbance": groups, "disturbance_time_constant": time}
    back = IdentifiedModel.from_dict(signed(body))
    assert back.dynamics.states == model.dynamics.states
    assert back.dynamics.parameters == model.dynamics.parameters
    assert back.weak == pytest.approx(model.weak)


PARTS = (
    LowPass(sensor="gyro", time=0.005),
    Coloured(sensor="accelerometer", time=0.05),
    Drift(sensor="gyro"),
    Line(sensor="accelerometer", time=0.5, frequency=13.0),
    Delay(sensor="accelerometer", time=0.004),
    Gust(group="force", time=0.5),
    Disturbance(group="torque"),
)


def test_every_kind_comes_back_the_same(physics, tmp_path):
    assert {type(p) for p in PARTS} == set(KINDS)
    model = identified(Augmented(core=physics, parts=PARTS))
    path = model.save(tmp_path / "model.json")
    back = IdentifiedModel.load(path)
    assert back.dynamics.parts == PARTS
    assert back.dynamics.states == model.dynamics.states
    assert back.dynamics.parameters == model.dynamics.parameters
    assert back.save(tmp_path / "again.json").read_bytes() == path.read_bytes()
    schema = json.loads(
        (Path(identified_module.__file__).parents[1] / "schemas/model.json").read_text()
    )
    record = schema["$defs"]["physics"]["properties"]["noise_parts"]["items"]["properties"]
    assert set(record["kind"]["enum"]) == {k.kind for k in KINDS}
    assert {name for p in PARTS for name in p.to_dict()} == set(record)


@pytest.mark.parametrize("part", PARTS, ids=lambda p: p.name)
def test_a_part_is_known_by_its_name_with_the_start_values_of_its_kind(part):
    named = part_named(f"{part.kind}.{part.name.split('.')[1]}")
    assert type(named) is type(part)
    assert named.name == part.name


@pytest.mark.parametrize("name", ["low_pas.gyro", "low_pass", "low_pass.", ""])
def test_a_name_that_is_no_part_is_refused_with_those_that_are(name):
    with pytest.raises(UnknownNameError, match=r"low_pass\.<sensor or group>"):
        part_named(name)


@pytest.mark.parametrize(
    ("record", "said"),
    [
        ({"kind": "colored", "sensor": "gyro", "time": 0.1}, "coloured"),
        ({"kind": "low_pass", "time": 0.1}, "low_pass noise with time, expected sensor, time"),
        ({"kind": "low_pass", "sensor": "gyro", "time": None}, "time of low_pass noise is None"),
        ({"kind": "low_pass", "sensor": "gyroo", "time": 0.1}, "gyroo"),
        ({"kind": "low_pass", "sensor": ["gyro"], "time": 0.1}, "sensor of low_pass noise"),
        ("low_pass", "incomplete or wrong"),
    ],
)
def test_a_part_that_is_none_is_refused_in_one_line(physics, record, said):
    body = dict(identified(physics).to_dict())
    body["noise_parts"] = [record]
    with pytest.raises(GreyboxError, match=said):
        IdentifiedModel.from_dict(signed(body))


def test_a_model_knows_what_lies_under_its_noise(physics):
    model = identified(with_disturbance(physics, ("force",)))
    assert model.core is model.physics is physics
    assert model.effects == ("rotor_drag",)
    assert model.sensors == {"gyro", "accelerometer", "attitude"}
    assert model.channel_groups == physics.channel_groups
