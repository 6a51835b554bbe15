"""A test flight with a fault is named, and its fault is the likely reason of a bad verdict, not the
model."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import greybox as gb
from greybox.cli import main
from greybox.plants.flight_log import write_log
from greybox.plants.vehicle_file import write_vehicle
from tests.automatic.craft import flown, plant

COLUMNS = ("t", "u1", "u2", "u3", "u4", "qw", "qx", "qy", "qz", "p", "q", "r")
FAULT = "data fault in faulty: "


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sound training flight, and a test flight whose gyro is in degrees per second."""
    folder = tmp_path_factory.mktemp("faulty")
    for name, columns in zip(("sound", "faulty"), flown((1, 2)), strict=True):
        scale = np.degrees(1.0) if name == "faulty" else 1.0
        own = {k: scale * v if k in ("p", "q", "r") else v for k, v in columns.items()}
        write_log(folder / f"{name}.csv", {k: v for k, v in own.items() if k in COLUMNS})
    write_vehicle(folder / "v.toml", plant(), sigma={"inertia": 0.2, "thrust.c2": 0.2})
    return folder


def test_the_command_says_it_and_the_verdict_names_it(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    command = (
        "fit --vehicle v.toml --train sound.csv --test faulty.csv --manual --effects motor_lag"
    )
    main([*command.split(), "--out", "out"])
    assert f"greybox fit: {FAULT}" in capsys.readouterr().err
    content = json.loads((folder / "out" / "fit.json").read_text())
    assert any(w.startswith(FAULT) for w in content["warnings"])
    assert content["verdict"]["outcome"] == "not usable"
    assert content["verdict"]["anchor"] == "docs/bad_fit.md#a-log-has-a-fault"
    assert "faulty: " in content["verdict"]["reason"]


@pytest.mark.slow
def test_so_does_fit_in_python(folder):
    vehicle = gb.read_vehicle(folder / "v.toml")
    train, test = (gb.read_logs([folder / f"{n}.csv"], vehicle) for n in ("sound", "faulty"))
    said: list[str] = []
    result = gb.fit(
        vehicle, train, test=test, say=said.append, predictor="innovation", criterion="gaussian"
    )
    assert any(line.startswith(FAULT) for line in said)
    assert result.verdict is not None
    assert result.verdict.anchor == "docs/bad_fit.md#a-log-has-a-fault"
