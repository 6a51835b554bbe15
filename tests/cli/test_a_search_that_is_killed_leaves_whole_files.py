"""`greybox discover` killed at any fit (SIGINT, SIGKILL) leaves files that load, with the verdict
"stopped"; the same command goes on, and ends with what one says that nobody stopped."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from greybox.excitation.injection import rich_excitation
from greybox.excitation.waypoints import RandomWaypoints
from greybox.journal import FILE
from greybox.model.identified import IdentifiedModel
from greybox.plants.effects import RotationalDamping
from greybox.plants.flight_log import fly, member, write_log
from greybox.plants.presets import controller_for, x250
from greybox.plants.vehicle_file import write_vehicle

PATIENCE = 600.0
"""Seconds until a search must have done some fits, on a loaded machine."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Logs, a vehicle file, and the result of a search that nobody stopped, in `whole`."""
    place = tmp_path_factory.mktemp("killed")
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
        write_log(place / f"{name}.csv", member(log, i), drop=["omega"])
    write_vehicle(place / "v.toml", plant, sigma={"inertia": 0.2, "thrust.c2": 0.2})
    assert searching(place, "whole").wait() == 0
    return place


def searching(place: Path, out: str) -> subprocess.Popen[bytes]:
    """The command, begun; what it says goes to a file beside its folder."""
    words = ["discover", "--vehicle", "v.toml", "--train", "a.csv", "--test", "b.csv"]
    with (place / f"{out}.txt").open("wb") as said:
        return subprocess.Popen(
            [sys.executable, "-m", "greybox", *words, "--out", out],
            cwd=place,
            stdout=said,
            stderr=said,
            start_new_session=True,
            # Who starts the tests in the background of a script has them ignore the signal.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )


def lines(place: Path) -> int:
    """Lines of the journal of a search."""
    return place.read_bytes().count(b"\n") if place.exists() else 0


def result(out: Path) -> tuple[dict[str, Any], str]:
    """What a search says, but when and how it was asked, and its model."""
    content = json.loads((out / "discovery.json").read_text())
    kept = {k: v for k, v in content.items() if k not in ("seconds", "command")}
    return kept, (out / "model.json").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_a_search_that_is_killed_goes_on(folder: Path, how: signal.Signals) -> None:
    out = folder / how.name
    journal = out / FILE
    for fits in (2, 9, 15):
        process = searching(folder, how.name)
        limit = time.monotonic() + PATIENCE
        while lines(journal) <= fits and process.poll() is None and time.monotonic() < limit:
            time.sleep(0.02)
        os.killpg(process.pid, how)
        code = process.wait(60)
        said = (folder / f"{how.name}.txt").read_text().splitlines()
        assert code == (130 if how is signal.SIGINT else -how), said
        if how is signal.SIGINT:
            assert "the same command goes on: greybox discover --vehicle v.toml" in said[-1]
        assert ("going on where it was stopped" in said[0]) == (fits > 2)
        left = json.loads((out / "discovery.json").read_text())
        assert left["verdict"] == "stopped" and "taken up so far, not certified" in left["line"]
        assert left["effects"] == []
        assert "gyro_bias" in IdentifiedModel.load(out / "model.json").effects
        with journal.open("ab") as stream:  # as if it had been killed while it wrote
            stream.write(b'{"key": "0123')
    assert searching(folder, how.name).wait() == 0
    assert result(out) == result(folder / "whole")
    assert {p.name for p in out.iterdir()} == {"discovery.json", "model.json", "report.html"}
