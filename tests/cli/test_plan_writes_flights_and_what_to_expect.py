"""`greybox plan` writes setpoints, picture, report and plan.json as published, and refuses bad
wishes in one line."""

from __future__ import annotations

import json
from importlib.resources import files
from xml.etree import ElementTree

import jsonschema
import numpy as np
import pytest

from greybox.cli import main
from greybox.data.logs import read_log
from greybox.model.vehicle import read_vehicle
from greybox.model.vehicle_template import template_text
from tests.mpc_export import cases

SCHEMA = json.loads(files("greybox").joinpath("schemas/plan.json").read_text())


@pytest.fixture
def vehicle(tmp_path):
    path = tmp_path / "v.toml"
    path.write_text(template_text("crazyflie"))
    return path


def test_a_plan_is_written_whole(vehicle, tmp_path, capsys):
    out = tmp_path / "out"
    command = [
        "plan",
        "--vehicle",
        str(vehicle),
        "--for",
        "rotor_drag",
        "--seconds",
        "8",
        "--piece",
        "4",
        "--flights",
        "2",
        "--rate",
        "50",
    ]
    assert (
        main(
            [
                *command,
                "--box",
                "3,3,2",
                "--setpoints-only",
                "--out",
                str(out),
                "--json",
                str(tmp_path / "p.json"),
            ]
        )
        == 0
    )
    said = capsys.readouterr()
    assert "rotor_drag.k_x" in said.out and "std after" in said.out and "flown: hover" in said.err
    content = json.loads((out / "plan.json").read_text())
    jsonschema.validate(content, SCHEMA)
    assert content == json.loads((tmp_path / "p.json").read_text())
    assert [f["file"] for f in content["flights"]] == ["flight_1.csv", "flight_2.csv"]
    table = np.genfromtxt(out / "flight_1.csv", delimiter=",", names=True)
    assert table.size == 200 and table["t"][1] == pytest.approx(0.02)
    # The expected flight is a log like any other.
    log = read_log(out / "expected_1.csv", read_vehicle(vehicle))
    assert {"x", "qw", "p", "ax", "u1"} <= set(log.channels)
    assert (out / "plan.png").read_bytes().startswith(b"\x89PNG")
    page = (out / "report.html").read_text()
    ElementTree.fromstring(page.removeprefix("<!DOCTYPE html>\n"))
    assert "What to do next" in page and "std naive" in page


def test_a_fitted_model_is_planned_for_as_well(vehicle, tmp_path, capsys):
    model = tmp_path / "model.json"
    cases.physics().save(model)
    command = [
        "plan",
        "--model",
        str(model),
        "--vehicle",
        str(vehicle),
        "--seconds",
        "4",
        "--piece",
        "2",
    ]
    assert main([*command, "--setpoints-only", "--out", str(tmp_path / "out"), "--json", "-"]) in (
        0,
        1,
    )
    said = capsys.readouterr()
    assert "another vehicle file" in said.err
    content = json.loads(said.out)
    jsonschema.validate(content, SCHEMA)
    assert content["effects"] == list(cases.physics().effects)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--for", "rotor_drug"], "rotor_drag"),
        (["--box", "4,4"], "3 numbers"),
        (["--box", "0.1,4,2"], "no room"),
        (["--tilt", "60"], "tilt"),
        (["--seconds", "nan"], "--seconds"),
        (["--rate", "1"], "--rate"),
        (["--command", "0.9,0.95"], "hover"),
        (["--value", "masse=1"], "mass"),
        (["--model", "model.json"], "no such file"),
    ],
)
def test_bad_wishes_are_one_line_and_write_nothing(vehicle, options, words, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["plan", "--vehicle", str(vehicle), *options, "--out", str(out)]) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.startswith("greybox plan: ") and words in error
    assert not out.exists()


def test_neither_vehicle_nor_model(capsys):
    assert main(["plan"]) == 2
    assert "--vehicle V.toml" in capsys.readouterr().err
