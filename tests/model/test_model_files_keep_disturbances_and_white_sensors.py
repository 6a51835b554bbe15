"""A model file names the disturbed groups as it always did; a model of coloured sensors is
refused."""

from __future__ import annotations

import json

import numpy as np
import pytest

from greybox.errors import ModelError
from greybox.files import checksum
from greybox.model.identified import IdentifiedModel
from greybox.model.model import build_model
from greybox.model.noise import Augmented, Coloured, Disturbance, with_disturbance
from greybox.model.parameter import ParameterValues
from greybox.model.vehicle import read_vehicle
from scenarios.plants.presets import x250
from scenarios.plants.vehicle_file import write_vehicle

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
    assert body["disturbance"] == ["force", "torque"]
    assert body["disturbance_time_constant"] == 0.5
    assert list(body["values"])[-2:] == ["disturbance.force.T", "disturbance.torque.T"]
    assert list(body["process_noise"])[6:] == [
        f"disturbance.{g}.{a}" for g in ("force", "torque") for a in "xyz"
    ]
    assert body["name"] == f"{physics.name}, disturbance force, torque"
    back = IdentifiedModel.load(path)
    assert back.dynamics.states == model.dynamics.states
    assert back.dynamics.parameters == model.dynamics.parameters
    assert back.save(tmp_path / "again.json").read_bytes() == path.read_bytes()


def test_a_model_without_disturbances_says_so(physics):
    body = identified(physics).to_dict()
    assert body["disturbance"] == []
    assert body["disturbance_time_constant"] is None


def test_groups_in_any_order_are_the_same_states(physics):
    """A file that names torque before force has its numbers in the order of the process noise all
    the same."""
    model = identified(with_disturbance(physics, ("torque", "force")))
    body = dict(model.to_dict())
    assert body["disturbance"] == ["force", "torque"]
    body["disturbance"] = ["torque", "force"]
    body["checksum"] = checksum(
        {k: v for k, v in body.items() if k not in ("checksum", "versions")}
    )
    back = IdentifiedModel.from_dict(body)
    assert back.dynamics.states.names == model.dynamics.states.names
    assert back.weak == pytest.approx(model.weak)


def test_a_file_has_no_place_for_coloured_sensors(physics):
    parts = (Coloured(sensor="gyro", time=0.05), Disturbance(group="force"))
    with pytest.raises(ModelError, match=r"white noise of the sensors.*coloured\.gyro"):
        identified(Augmented(core=physics, parts=parts)).to_dict()
    apart = (Disturbance(group="force", time=0.5), Disturbance(group="torque"))
    with pytest.raises(ModelError, match="one start value of all correlation times"):
        identified(Augmented(core=physics, parts=apart)).to_dict()


def test_a_model_knows_what_lies_under_its_noise(physics):
    model = identified(with_disturbance(physics, ("force",)))
    assert model.core is model.physics is physics
    assert model.effects == ("rotor_drag",)
    assert model.sensors == {"gyro", "accelerometer", "attitude"}
    assert model.channel_groups == physics.channel_groups
