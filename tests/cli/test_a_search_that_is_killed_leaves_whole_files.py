"""`greybox discover` killed by the system (SIGKILL) leaves files that load, with the verdict
"stopped"."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from greybox.excitation.injection import rich_excitation
from greybox.excitation.waypoints import RandomWaypoints
from greybox.model.identified import IdentifiedModel
from greybox.plants.effects import RotationalDamping
from greybox.plants.flight_log import fly, member, write_log
from greybox.plants.presets import controller_for, x250
from greybox.plants.vehicle_file import write_vehicle

PATIENCE = 300.0
"""Seconds until the first step of a search must have been written, on a loaded machine."""


@pytest.mark.slow
def test_what_a_killed_search_left_loads_and_says_stopped(tmp_path: Path) -> None:
    plant = x250([RotationalDamping(d_p=4e-3, d_q=4e-3, d_r=4e-3)])
    log = fly(
        plant,
        controller_for(plant),
        RandomWaypoints(),
        rich_excitation(),
        4.0,
        seed=[1, 2],
        warm_up=1.0,
    )
    for i, name in enumerate(("a", "b")):
        write_log(tmp_path / f"{name}.csv", member(log, i), drop=["omega"])
    write_vehicle(tmp_path / "v.toml", plant, sigma={"inertia": 0.2, "thrust.c2": 0.2})
    command = [
        sys.executable,
        "-m",
        "greybox",
        "discover",
        "--vehicle",
        "v.toml",
        "--train",
        "a.csv",
        "--test",
        "b.csv",
    ]
    result = tmp_path / "out" / "discovery.json"
    process = subprocess.Popen(
        [*command, "--out", "out"],
        cwd=tmp_path,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        limit = time.monotonic() + PATIENCE
        while not result.exists() and process.poll() is None and time.monotonic() < limit:
            time.sleep(0.02)
    finally:
        process.kill()
    assert process.wait() == -signal.SIGKILL
    left = json.loads(result.read_text())
    assert left["verdict"] == "stopped"
    assert left["effects"] == []
    assert "gyro_bias" in IdentifiedModel.load(tmp_path / "out" / "model.json").effects
