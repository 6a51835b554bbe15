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


def in_thick_air(late: float = 0.0, dt: float = 0.01) -> RawLog:
    """Twelve seconds of wide curves in air that takes .08 of the speed squared, exact but for a
    velocity that is `late` [s]: as a simulator logs them, without an accelerometer."""
    t = np.arange(0.0, 12.0, dt)
    roll, pitch = 0.4 * np.sin(0.9 * t), 0.35 * np.sin(0.8 * t + 1.0)
    half = [np.cos(roll / 2), np.sin(roll / 2), np.cos(pitch / 2), np.sin(pitch / 2)]
    q = (half[2] * half[0], half[2] * half[1], half[3] * half[0], -half[3] * half[1])
    thrust = 10.0 + 0.8 * np.sin(1.7 * t)
    up = np.cos(roll)
    push = np.column_stack([np.sin(pitch) * up, -np.sin(roll), np.cos(pitch) * up])
    force = thrust[:, None] * push - [0.0, 0.0, 9.80665]
    force[:, 2] -= force[:, 2].mean()
    v = np.zeros((t.size, 3))
    for k in range(t.size - 1):
        v[k + 1] = v[k] + dt * (force[k] - 0.08 * np.linalg.norm(v[k]) * v[k])
    seen = np.column_stack([np.interp(t - late, t, one) for one in v.T])
    columns = {**dict(zip(("qw", "qx", "qy", "qz"), q)), **dict(zip(("vx", "vy", "vz"), seen.T))}
    columns |= {f"u{i}": np.sqrt(thrust / 20.0) for i in (1, 2, 3, 4)}
    return replace(real(SET, CUTS[0][0]), t=t, rows=np.arange(t.size), channels=columns, extra={})


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


def test_drag_is_no_delay_of_the_velocity() -> None:
    assert not found(in_thick_air()).of("acceleration")


def test_a_delay_is_found_beside_drag() -> None:
    (fault,) = found(in_thick_air(late=0.25)).of("acceleration")
    assert fault.evidence["delay_s"] == pytest.approx(0.25, abs=0.06)


def test_thrust_that_pushes_down_is_said_to_be_of_other_frames() -> None:
    """Attitude, rates and motion of a simulator that counts z downwards, read as if upwards."""
    raw = in_thick_air()
    down = with_channels(raw, **{n: -raw.channels[n] for n in ("qy", "qz", "vy", "vz")})
    (fault,) = found(down).of("acceleration")
    assert fault.severity == "blocking" and "z is down" in fault.message
    assert "frame = 'FRD/NED' in [columns.attitude]" in fault.fix
