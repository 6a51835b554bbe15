"""Whatever numbers a log holds, `check` judges it without a word of NumPy, or refuses it in one
line."""

from __future__ import annotations

import functools
import gzip
import warnings
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from greybox.cli import main
from greybox.data import RawLog
from greybox.data.checks import check
from greybox.data.raw import LARGEST
from greybox.errors import DataError
from greybox.examples import flight_path, vehicle_path
from tests.data.faults import real, vehicle

SET, FLIGHT = "nanobench", "B2_circle_medium_rep1"
POSE = ["x", "y", "z", "vx", "vy", "vz", "qw", "qx", "qy", "qz"]
GROUPS = {
    "position": POSE[:3],
    "velocity": POSE[3:6],
    "attitude": POSE[6:],
    "gyro": ["p", "q", "r"],
    "accelerometer": ["ax", "ay", "az"],
    "command": ["u1", "u2", "u3", "u4"],
}
ROW = 100


def lone(value: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda v: np.where(np.arange(v.size) == ROW, value, v)


def noise(size: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda v: size * np.random.default_rng(v.size).standard_normal(v.size)


VALUES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "missing": lambda v: np.full(v.size, np.nan),
    "infinite": lambda v: np.full(v.size, -np.inf),
    "one infinite": lone(np.inf),
    "one that is the largest": lone(np.finfo(float).max),
    "one that is the largest of a sensor": lone(LARGEST),
    "all but the largest": lambda v: 1e37 * v,
    "beyond the largest": lambda v: 1e300 * v,
    "in turns": lambda v: 1e300 * (-1.0) ** np.arange(v.size),
    "noise": noise(1e154),
    "denormal": lambda v: 1e-310 * v,
    "zero": np.zeros_like,
}
TIMES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "far from zero": lambda t: t + 1e15,
    "of an epoch": lambda t: t + 1.7e9,
    "before zero": lambda t: t - 1e6,
    "tiny": lambda t: 1e-300 * t,
    "large": lambda t: 1e9 * t,
    "standing": np.zeros_like,
    "backwards": lambda t: t[::-1].copy(),
    "a last stamp of another year": lambda t: np.append(t[:-1], 3e7),
    "two rates": lambda t: np.cumsum(np.where(np.arange(t.size) < t.size // 2, 0.01, 0.004)),
    "at random": lambda t: np.sort(np.random.default_rng(1).uniform(0, t[-1], t.size)),
    "ever slower": lambda t: np.logspace(-3, 3, t.size),
    "in pairs": lambda t: np.repeat(t[::2], 2)[: t.size] + np.arange(t.size) % 2 * 1e-6,
}


def changed(names: list[str], change: Callable[[np.ndarray], np.ndarray]) -> RawLog:
    raw = real(SET, FLIGHT)
    return replace(
        raw,
        channels={
            **raw.channels,
            **{n: change(raw.channels[n]) for n in names if n in raw.channels},
        },
    )


def judged(raw: RawLog) -> set[str]:
    """(severity, check) of what is found; warnings of NumPy are errors."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        report = check([raw], vehicle(SET))
        assert max(map(len, report.summary().splitlines())) < 500
        assert not any(" nan" in f.message or " inf " in f.message for f in report.findings)
    return {f"{f.severity} {f.check}" for f in report.findings}


@functools.cache
def sound() -> set[str]:
    """What is found in the flight as it came."""
    return judged(real(SET, FLIGHT))


FEW = (*(("every channel", v) for v in VALUES), *((g, "noise") for g in GROUPS))


@pytest.mark.parametrize(
    ("group", "value"),
    [
        pytest.param(g, v, marks=() if (g, v) in FEW else pytest.mark.slow)
        for g in (*GROUPS, "every channel")
        for v in VALUES
    ],
)
def test_values(group: str, value: str) -> None:
    names = GROUPS.get(group, list(real(SET, FLIGHT).channels))
    found = judged(changed(names, VALUES[value]))
    if value in ("infinite", "all but the largest", "beyond the largest", "in turns", "noise"):
        assert "blocking ranges" in found
    if value.startswith("one "):
        assert "warning ranges" in found
    if value == "missing":
        assert "warning gaps" in found
    assert found - sound()


RARE = ("before zero", "large", "tiny", "ever slower", "two rates")
"""As far from a clock as others are."""


@pytest.mark.parametrize(
    "times", [pytest.param(t, marks=pytest.mark.slow) if t in RARE else t for t in TIMES]
)
def test_time_stamps(times: str) -> None:
    raw = real(SET, FLIGHT)
    found = judged(replace(raw, t=TIMES[times](raw.t)))
    # a moment of its own is no fault; all else is said
    assert bool(found - sound()) is (times not in ("of an epoch", "before zero"))


@pytest.mark.parametrize("step", [2, 7, 25])
def test_channels_at_rates_of_their_own_pass(step: int) -> None:
    slow = changed(POSE, lambda v: np.where(np.arange(v.size) % step == 0, v, np.nan))
    battery = np.where(np.arange(slow.n) % 50 == 3, slow.channels["vbat"], np.nan)
    found = judged(replace(slow, channels={**slow.channels, "vbat": battery}))
    assert not {f for f in found if f.startswith("blocking")}


@pytest.mark.parametrize("stamp", [np.nan, np.inf, -np.inf, 1e300])
@pytest.mark.parametrize("row", [0, ROW, -1])
def test_stamps_that_are_no_numbers_are_refused(stamp: float, row: int) -> None:
    raw = real(SET, FLIGHT)
    t = raw.t.copy()
    t[row] = stamp
    with pytest.raises(DataError, match=r"1 time stamp\(s\) that are no numbers"):
        check([replace(raw, t=t)], vehicle(SET))


def test_what_is_no_log_is_refused() -> None:
    raw = real(SET, FLIGHT)
    none = replace(
        raw, t=raw.t[:0], rows=raw.rows[:0], channels={k: v[:0] for k, v in raw.channels.items()}
    )
    for wrong, words in (
        (none, "without rows"),
        (replace(raw, channels={}), "without channels"),
        (replace(raw, t=raw.t[:-1]), "not one value per time stamp"),
    ):
        with pytest.raises(DataError, match=words):
            check([wrong], vehicle(SET))
    one = replace(
        raw, t=raw.t[:1], rows=raw.rows[:1], channels={k: v[:1] for k, v in raw.channels.items()}
    )
    judged(one)


@pytest.mark.parametrize("cell", ["1e300", "-1e39", "inf"])
def test_a_cell_that_no_sensor_writes_is_refused_with_its_row(cell: str, tmp_path, capsys) -> None:
    rows = gzip.decompress(flight_path(SET, FLIGHT).read_bytes()).decode().splitlines()
    column = vehicle(SET).columns.sources["position"].fields[0]
    cells = rows[ROW].split(",")
    cells[rows[0].split(",").index(column)] = cell
    rows[ROW] = ",".join(cells)
    path = tmp_path / "f.csv"
    path.write_text("\n".join(rows) + "\n")
    code = main(["check", "--vehicle", str(vehicle_path(SET)), str(path)])
    said = capsys.readouterr().err
    assert (code, f"row {ROW + 1}, column '{column}'" in said, len(said.splitlines())) == (
        2,
        True,
        1,
    ), said
