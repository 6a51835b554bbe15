"""A flight in PX4's format, as a user has it: inspect, check, fit, validate and discover with the
whole catalogue."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from greybox.cli import main
from greybox.excitation.figure_eight import FigureEight
from greybox.plants.presets import X250, x250
from greybox.plants.vehicle_file import write_vehicle
from scenarios.studies.discovery_cells import ERRORS, SIGMA, effect_of, logs
from tests.data.readers.writers import write_ulog

pytestmark = pytest.mark.slow


def test_a_hidden_drag_is_found(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    pytest.importorskip("pyulog")
    plant = x250([effect_of("rotor_drag", X250)])
    vehicle = str(write_vehicle(tmp_path / "v.toml", plant, sigma=SIGMA, errors=ERRORS))
    flown = [
        *logs(plant, [31001, 31002], 16.0),
        *logs(plant, [31051], 8.0, FigureEight(climb=0.3, yaw_rate=0.4)),
    ]
    a, b, c = (
        str(
            write_ulog(
                tmp_path / f"{name}.ulg",
                log | {f"sp_{k}": np.zeros(len(log["t"])) for k in "xyz"},
                slow_every=1,
            )
        )
        for name, log in zip("abc", flown, strict=True)
    )
    assert main(["inspect", a, "--vehicle", vehicle]) == 0
    shown = capsys.readouterr().out
    said = re.search(r"effects: (\d+) of (\d+)", shown)
    assert said and int(said[1]) >= 29
    lacking = re.findall(r"^    (\w+) lacks (.*)$", shown, re.M)
    assert len(lacking) == int(said[2]) - int(said[1])
    assert all("rotor_speed" in why for _, why in lacking), "the log can show all others"
    assert main(["check", a, "--vehicle", vehicle]) == 0
    fitted = tmp_path / "fit"
    arguments = [
        "fit",
        "--manual",
        "--vehicle",
        vehicle,
        "--train",
        a,
        b,
        "--effects",
        "rotor_drag",
    ]
    assert main([*arguments, "--out", str(fitted)]) == 0
    assert main(["validate", str(fitted / "model.json"), "--log", c]) == 0
    out = tmp_path / "found.json"
    arguments = [
        "discover",
        "--vehicle",
        vehicle,
        "--train",
        a,
        b,
        "--test",
        c,
        "--out",
        str(tmp_path / "found"),
    ]
    assert main([*arguments, "--json", str(out)]) == 0
    found = json.loads(out.read_text())
    assert found["verdict"] == "named"
    ((name, parameters),) = [(e["name"], e["parameters"]) for e in found["effects"]]
    assert name == "rotor_drag"
    for key, true in plant.effects[0].parameters().items():
        p = parameters[key.split(".")[1]]
        assert abs(p["value"] - float(true)) < 4 * p["std"]
    assert found["unnamed"] == []
