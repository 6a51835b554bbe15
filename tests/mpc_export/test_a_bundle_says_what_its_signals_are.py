"""Which rotor a command drives, and how it was made of what the logs hold, goes from the log to the
model file and from there to manifest, header and the READMEs of autopilots."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from greybox.data import Dataset
from greybox.data.readers.recipes import recipes
from greybox.data.readers.recording import Source
from greybox.estimation.fit import fit
from greybox.examples import vehicle_path
from greybox.linear.logs import ChannelSpec
from greybox.model.identified import IdentifiedModel
from greybox.model.layer import physics_of
from greybox.model.linear import LinearModel
from greybox.model.vehicle import read_vehicle
from greybox.simulators.data_sheet import model_of
from greybox.symbolic import Layout
from mpc_export.bundle import describe, write_bundle
from mpc_export.functions import model_functions
from mpc_export.signals import told
from tests.motor import model, record
from tests.mpc_export import cases

MADE = {f"u{i}": f"(pwm{i} - 1000) / 1000" for i in range(1, 5)}


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ({"fields": ("pwm1", "pwm2"), "limits": (1000.0, 2000.0)}, "(pwm1 - 1000) / 1000"),
        ({"fields": ("m1", "m2"), "stream": "motor", "limits": (0.0, 65535.0)}, "motor.m1 / 65535"),
        ({"fields": ("a", "b"), "scale": (1.0, 2.0), "offset": (-3.0, 0.0)}, "a - 3"),
        ({"fields": ("-a", "b")}, "-a"),
        ({"fields": ("a", "b"), "delay": 0.01}, "a, 10 ms before its stamp"),
        ({"fields": ("u1", "u2")}, None),
    ],
)
def test_a_command_is_said_as_arithmetic(source, said):
    found = recipes(Source(group="command", **{"stream": "table", **source}))
    assert found.get("u1") == said


@pytest.mark.parametrize("ends", [(0.0, 1.0), (0.1, 0.8)])
def test_commands_have_the_range_of_the_vehicle_file(ends):
    own = cases.physics()
    vehicle = own.physics.vehicle
    actuator = replace(vehicle.actuator, u_min=ends[0], u_max=ends[1])
    physics = replace(own.physics, vehicle=replace(vehicle, actuator=actuator))
    found = model_functions(replace(own, dynamics=physics))
    for bound, end in zip(found.bounds, ends, strict=True):
        np.testing.assert_array_equal(bound, np.full(4, end))


def test_units_and_axes_are_said_too():
    rate = {"group": "rate", "stream": "table", "fields": ("gx", "gy", "gz"), "unit": "deg/s"}
    assert recipes(Source(**rate))["p"] == "0.0174533 gx"
    assert recipes(Source(**rate, frame="FRD"))["r"] == "from gx, gy, gz [deg/s], FRD"
    euler = Source(group="attitude", stream="imu", fields=("r", "p", "y"), unit="rad")
    scaled = recipes(Source(**rate, frame="FRD", scale=2.0, offset=(0.1, 0.0, -0.2)))
    assert scaled["p"] == "from 0.0349066 gx + 0.1, 0.0349066 gy, 0.0349066 gz - 0.2, FRD"
    motors = {"group": "command", "stream": "table", "fields": ("m1", "m2")}
    roots = recipes(Source(**motors, limits=(0.0, 9.0), convert=np.sqrt, note="roots"))
    assert roots["u2"] == "from converted m1 / 9, converted m2 / 9, roots"
    assert recipes(euler)["qw"] == "from imu.r, imu.p, imu.y [rad]"


def test_a_fit_keeps_the_recipes_of_its_flights_and_so_does_its_file(tmp_path):
    flight = Dataset.of(record(200)).flights[0]
    name = flight.channels[0]
    one = replace(flight, recipes={name: "raw / 2"})
    two = replace(flight, name="two")
    assert Dataset(flights=(one, two)).recipes == {name: f"raw / 2 or {name}"}
    fitted = fit(model(), Dataset.of(one), free=("R",)).model
    assert fitted.recipes == {name: "raw / 2"}
    path = cases.physics().save(tmp_path / "none.json")
    assert "recipes" not in json.loads(path.read_text()), "a file without is as it was"
    assert IdentifiedModel.load(path).recipes is None
    for some in (MADE, {}):
        path = replace(cases.physics(), recipes=some).save(tmp_path / "some.json")
        assert IdentifiedModel.load(path).recipes == some


def test_a_vehicle_speaks_only_where_the_flights_do_not():
    untold = model_of(read_vehicle(vehicle_path("nanobench")))
    for own, said in ((None, "its vehicle says: in logs "), ({}, "")):
        one = replace(untold, recipes=own)
        meanings = [s.meaning for s in told(one.dynamics.inputs, one, one.dynamics)]
        assert any("in logs" in m for m in meanings) == bool(said)
        assert all(said in m for m in meanings)


def test_header_manifest_and_readmes_say_it(tmp_path):
    own = replace(cases.disturbed(), recipes=MADE)
    targets = ("crazyflie-app", "px4-module", "ros2")
    made = write_bundle(own, tmp_path / "craft", targets=targets, real="float", use_cache=False)
    row = made.manifest["inputs"][0]
    assert row["meaning"].endswith("; in the logs (pwm1 - 1000) / 1000")
    rotor = physics_of(own.dynamics).vehicle.rotors[0]
    turns = "counter-clockwise" if rotor.spin > 0 else "clockwise"
    side = "left" if rotor.position[1] >= 0 else "right"
    assert re.search(rf"rotor [\d.e-]+ m \w+, [\d.e-]+ m {side}, {turns} seen", row["meaning"])
    header = (made.folder / "c" / "craft_model.h").read_text(encoding="utf-8")
    assert re.sub(r"\s+", " ", header).count(" - 1000) / 1000 */") == 4
    for readme in ("README.md", "crazyflie/README.md", "px4/README.md", "ros2/README.md"):
        text = (made.folder / readme).read_text(encoding="utf-8")
        assert row["meaning"] in text, readme
    app = (made.folder / "crazyflie" / "README.md").read_text(encoding="utf-8")
    assert "commands are the ratios" not in app, "what the logs had is not known by the target"


def test_a_channel_that_is_a_sum_says_so_from_the_command_line_to_c(tmp_path):
    spec = ChannelSpec.parse("roll=-u1-u2+0.5*u3+u4")
    signal = spec.made_of({"u1": "pwm1 / 65535"})
    assert signal.meaning == "-u1 - u2 + 0.5 u3 + u4; u1 = pwm1 / 65535"
    assert ChannelSpec.parse("u1").signal.meaning == ""
    plain = cases.linear()
    first, *rest = plain.inputs
    inputs = Layout([replace(first, meaning=signal.meaning), *rest])
    model = replace(plain, inputs=inputs)
    back = LinearModel.load(model.save(tmp_path / "model.json"))
    assert back.inputs == inputs
    assert "meaning" not in json.dumps(plain.to_dict())
    made = write_bundle(back, tmp_path / "b", use_cache=False)
    header = (made.folder / "c" / "b_model.h").read_text(encoding="utf-8")
    for text in (header, (made.folder / "README.md").read_text(encoding="utf-8")):
        assert signal.meaning in text
    np.testing.assert_array_equal(back.matrices.a, model.matrices.a)


def test_a_range_of_training_is_not_passed_off_as_a_limit_of_the_machine(tmp_path):
    seen = "bounds of the commands are the range seen in training"
    own = cases.own()
    own = replace(own, domain=dict.fromkeys(own.dynamics.inputs.names, (-2.0, 3.0)))
    made = write_bundle(own, tmp_path / "my exports" / "own", use_cache=False)
    assert made.manifest["inputs"][0]["upper"] == 3.0
    assert any(n.startswith(seen) for n in made.manifest["notes"])
    assert f"mpc_export.verify '{made.folder}'" in describe(made)
    vehicle = write_bundle(cases.disturbed(), tmp_path / "craft", use_cache=False)
    assert not any(n.startswith(seen) for n in vehicle.manifest["notes"])
