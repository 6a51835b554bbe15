"""Faults put into the file of a real flight: `greybox check` blocks, warns, refuses the file, or
the fault does no harm.

The table of docs/hardening.md says the same, fault by fault.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from greybox.cli import main
from greybox.data import read_log
from greybox.data.checks import check_logs
from greybox.examples import vehicle_path
from greybox.model.vehicle import read_vehicle
from tests.hardening.log_faults import FAULTS, SET, flight

PAGE = Path(__file__).resolve().parents[2] / "docs" / "hardening.md"
CLEAN = {("warning", "alignment")}
"""What `check` says of the flight as it came: its gyro's clock wanders."""

BLOCKED = {
    "repeated rows": "clock",
    "clock jump": "gaps",
    "clock set back": "clock",
    "shuffled rows": "clock",
    "time in ms": "clock",
    "wrong rate": "clock",
    "shifted clock": "alignment",
    "stuck sensor": "frozen",
    "swapped axes": "attitude",
    "reversed axis": "attitude",
    "body axes FRD": "gravity",
    "world axes NED": "gravity",
    "gyro in deg/s": "attitude",
    "accelerometer in m/s^2": "gravity",
    "position in mm": "motion",
    "swapped motors": "motors",
    "quaternion order": "attitude",
    "quaternion direction": "attitude",
}
WARNED = {
    "dropped rows": "gaps",
    "lost second": "gaps",
    "jitter": "clock",
    "spikes": "ranges",
    "saturated sensor": "saturation",
    "constant channel": "frozen",
}
REFUSED = {
    "truncated file": "cut off",
    "missing column": "motor_motor_m4",
    "thousands comma": "32 cells",
}
SURVIVED = ("NaN burst", "mixed line ends", "byte order mark", "quantised sensor", "decimal comma")
STEP = {"quantised sensor": 0.02}


def written(name: str, folder: Path) -> Path:
    """The faulty file."""
    path = folder / "flight.csv"
    path.write_bytes(FAULTS[name][1](flight()))
    return path


def found(path: Path) -> set[tuple[str, str]]:
    """(severity, check) of the blocking findings and warnings."""
    report = check_logs([path], read_vehicle(vehicle_path(SET)))
    return {(f.severity, f.check) for f in report.findings if f.severity != "info"}


def test_every_fault_has_one_outcome() -> None:
    outcomes = [*BLOCKED, *WARNED, *REFUSED, *SURVIVED]
    assert sorted(outcomes) == sorted(FAULTS)
    assert len(outcomes) == 32


def test_the_flight_as_it_came(tmp_path: Path) -> None:
    path = tmp_path / "flight.csv"
    path.write_bytes(flight().csv())
    assert found(path) == CLEAN


ELSEWHERE = (
    "reversed axis",
    "gyro in deg/s",
    "accelerometer in m/s^2",
    "quaternion order",
    "quaternion direction",
    "time in ms",
    "swapped motors",
)
"""Put into another flight by tests/data/test_injected_faults_are_found_and_clean_flights_pass.py."""


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow) if n in ELSEWHERE else n for n in BLOCKED]
)
def test_faults_that_block_a_fit(name: str, tmp_path: Path) -> None:
    assert ("blocking", BLOCKED[name]) in found(written(name, tmp_path))


@pytest.mark.parametrize("name", WARNED)
def test_faults_that_are_warned_of(name: str, tmp_path: Path) -> None:
    got = found(written(name, tmp_path))
    assert ("warning", WARNED[name]) in got
    assert not any(severity == "blocking" for severity, _ in got)


@pytest.mark.parametrize("name", REFUSED)
def test_files_that_are_refused(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = written(name, tmp_path)
    assert main(["check", str(path), "--vehicle", str(vehicle_path(SET))]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 1
    assert REFUSED[name] in said.err


@pytest.mark.parametrize("name", SURVIVED)
def test_faults_that_do_no_harm(name: str, tmp_path: Path) -> None:
    path = written(name, tmp_path)
    assert found(path) == CLEAN
    vehicle = read_vehicle(vehicle_path(SET))
    faulty = read_log(path, vehicle)
    path.write_bytes(flight().csv())
    clean = read_log(path, vehicle)
    lost = 60 if name == "NaN burst" else 0
    for channel in ("p", "az", "u1", "x"):
        a = np.concatenate([s.matrix([channel]) for s in faulty.segments])
        b = np.concatenate([s.matrix([channel]) for s in clean.segments])
        there = np.isfinite(a)
        assert np.count_nonzero(np.isfinite(b)) - np.count_nonzero(there) == (
            lost if channel in ("p", "az") else 0
        )
        step = STEP.get(name, 0.0) if channel == "p" else 0.0
        assert np.abs(a[there] - b[there]).max() <= 0.5 * step + 1e-12


def test_the_page_says_what_happens() -> None:
    rows = dict(
        re.findall(
            r"^([^|\n]+?) \| [^|\n]+ \| ([^|\n]+?)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE
        )
    )
    said = {
        **{n: f"blocked by {c}" for n, c in BLOCKED.items()},
        **{n: f"warning of {c}" for n, c in WARNED.items()},
        **dict.fromkeys(REFUSED, "refused, one line"),
        **dict.fromkeys(SURVIVED, "survived"),
    }
    assert {n: rows.get(n) for n in said} == said
