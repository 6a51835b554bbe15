"""On a circle what the air takes of the speed is a turn of the frame, and so is a delay: on seconds
of a log of pose and commands they are not taken for one, and frames that are turned are found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greybox.data import RawLog
from greybox.data.checks import CheckReport, check
from tests.data.faults import real, vehicle, with_channels

SET = "nanobench"
POSE = ("x", "y", "z", "qw", "qx", "qy", "qz", "u1", "u2", "u3", "u4")
CUTS = (
    ("B5_helix_fast_mell_rep1", 6.0),
    ("B5_helix_medium_rep2", 12.0),
    ("B7_oval_medium_rep2", 18.0),
    ("B8_star_fast_rep3", 6.0),
)


def cut(flight: str, start: float, seconds: float = 6.0) -> RawLog:
    raw = real(SET, flight)
    t = raw.t - raw.t[0]
    rows = (t >= start) & (t < start + seconds)
    channels = {n: raw.channels[n][rows] for n in POSE}
    return replace(raw, t=raw.t[rows], rows=raw.rows[rows], channels=channels, extra={})


def turned(raw: RawLog, degrees: float) -> RawLog:
    """With the positions turned about the vertical against the attitude."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    x, y = raw.channels["x"], raw.channels["y"]
    return with_channels(raw, x=c * x - s * y, y=s * x + c * y)


def found(raw: RawLog) -> CheckReport:
    return check([raw], vehicle(SET))


@pytest.mark.parametrize(("flight", "start"), CUTS)
def test_seconds_of_a_right_log_are_not_accused(flight: str, start: float) -> None:
    assert not found(cut(flight, start)).of("acceleration")


@pytest.mark.parametrize(("flight", "start"), CUTS)
def test_a_quarter_turn_is_found_on_the_same_seconds(flight: str, start: float) -> None:
    assert [f.check for f in found(turned(cut(flight, start), 90.0)).blocking] == ["acceleration"]


@pytest.mark.parametrize("degrees", [20.0, -20.0])
def test_so_is_a_smaller_turn_where_the_craft_turns_both_ways(degrees: float) -> None:
    (fault,) = found(turned(cut("B3_figure8_fast_rep1", 8.0, 8.0), degrees)).of("acceleration")
    assert fault.severity == "blocking"
    assert fault.evidence["angle_deg"] == pytest.approx(20.0, abs=6.0)
