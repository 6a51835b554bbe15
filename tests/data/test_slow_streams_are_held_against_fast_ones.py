"""Positions, velocities and attitudes that are slower than the rows are held against the gyro and
the accelerometer over their own intervals: a fault of axes, units or clocks is named there, too."""

from __future__ import annotations

import functools
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from greybox.data import RawLog, read_table
from greybox.data.checks import CheckReport, check
from greybox.excitation import RandomWaypoints, rich_excitation
from greybox.model.vehicle import Vehicle, read_vehicle
from greybox.plants.effects import MotorLag, RotorDrag
from greybox.plants.flight_log import fly, write_log
from greybox.plants.presets import controller_for, x250
from greybox.plants.vehicle_file import write_vehicle
from tests.hardening.channel_faults import CHANNEL_FAULTS, A, P, Q, V, late, linear, signs, yaw

PLACES = {
    "outdoor": (0.01, {P: 10, V: 10, Q: 2}),
    "indoor": (0.004, {P: 7.5, Q: 7.5, V: 0}),
}
"""Step of the rows [s], and every how many of them has a sample; none at 0."""
OWN = {
    "accelerometer turned by 90 deg": linear(yaw(90.0), A),
    "x negated": signs("x"),
    "attitude forward, right, down": signs("qy qz"),
    "position turned by 90 deg": linear(yaw(90.0), P),
    "position in NED": linear(np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]), P),
}


seldom = functools.partial(pytest.param, marks=pytest.mark.slow)
"""What another row shows as well."""


def slower(raw: RawLog, every: dict[str, float]) -> RawLog:
    """The log whose slow channels stand only in some of its rows."""
    channels = dict(raw.channels)
    for names, pace in every.items():
        keep = np.zeros(raw.n, dtype=bool)
        if pace:
            keep[np.arange(0.0, raw.n, pace).astype(int)] = True
        for name in names.split():
            channels[name] = np.where(keep, channels[name], np.nan)
            if not pace:
                del channels[name]
    return replace(raw, channels=channels)


@functools.cache
def flown(place: str) -> tuple[RawLog, Vehicle]:
    """Twenty seconds of a simulated craft, logged as at this place."""
    dt, every = PLACES[place]
    plant = x250([MotorLag(tau=0.03), RotorDrag(k_x=5e-5, k_y=5e-5)])
    log = fly(plant, controller_for(plant), RandomWaypoints(), rich_excitation(), 20.0, dt, seed=3)
    with tempfile.TemporaryDirectory() as folder:
        write_vehicle(Path(folder) / "vehicle.toml", plant)
        vehicle = read_vehicle(Path(folder) / "vehicle.toml")
        raw = read_table(write_log(Path(folder) / "log.csv", log, drop=["omega"]), vehicle)
    return slower(raw, every), vehicle


@functools.cache
def judged(place: str, fault: str) -> CheckReport:
    """What is said of the flight with a fault."""
    raw, vehicle = flown(place)
    make = OWN.get(fault) or CHANNEL_FAULTS[fault].make
    return check([make(raw)], vehicle)


@pytest.mark.parametrize("place", PLACES)
def test_of_the_flight_as_it_came_nothing_is_said(place: str) -> None:
    raw, vehicle = flown(place)
    report = check([raw], vehicle)
    assert {f.check for f in report.findings if f.severity != "info"} <= {"excitation"}
    assert {u.check for u in report.not_judged} == (set() if place == "outdoor" else {"motion"})
    head = report.summary().splitlines()[0]
    assert ("not judged: motion" in head) == (place == "indoor")


@pytest.mark.parametrize(
    ("place", "fault", "of", "words"),
    [
        ("indoor", "attitude world to body", "attitude", "turns world into body"),
        ("indoor", "attitude forward, right, down", "attitude", "q = -q, r = -r"),
        ("indoor", "scalar last", "attitude", "the scalar comes last"),
        seldom("indoor", "gyro in deg/s", "attitude", "the gyro is in deg/s"),
        ("indoor", "position in NED", "acceleration", "y = the world's x, z = -z"),
        ("indoor", "position turned by 90 deg", "acceleration", "the world's x = -y, y = the"),
        ("indoor", "motion capture mirrored in y", "acceleration", "y = -y"),
        ("indoor", "position in mm", "acceleration", "the position or velocity is in mm"),
        ("indoor", "accelerometer turned by 90 deg", "acceleration", "the accelerometer's ax ="),
        seldom("outdoor", "attitude world to body", "attitude", "turns world into body"),
        ("outdoor", "x negated", "motion", "vx = -vx"),
        ("outdoor", "x and y of the position swapped", "motion", "vx = vy, vy = vx"),
        seldom("outdoor", "position in mm", "motion", "the position is in mm"),
        ("outdoor", "velocity in km/h", "motion", "the position moves 0.27"),
        seldom(
            "outdoor", "position and velocity in NED", "acceleration", "y = the world's x, z = -z"
        ),
        seldom("outdoor", "motion capture mirrored in y", "acceleration", "y = -y"),
        ("outdoor", "velocity in body axes", "motion", "the velocity is in body axes"),
        ("outdoor", "accelerometer in world axes", "acceleration", "is in world axes"),
        ("outdoor", "gyro in world axes", "attitude", "the gyro is in world axes"),
    ],
)
def test_a_fault_of_axes_or_units_blocks(place: str, fault: str, of: str, words: str) -> None:
    said = [f.message for f in judged(place, fault).blocking if f.check == of]
    assert any(words in m for m in said), said


def test_longitude_and_latitude_of_few_digits_block() -> None:
    raw, vehicle = flown("outdoor")
    degrees = {n: np.round(8.5 + raw.channels[n] / 111e3, 6) for n in "xy"}
    report = check([replace(raw, channels={**raw.channels, **degrees})], vehicle)
    (found,) = [f for f in report.blocking if f.check == "motion"]
    assert "in vx, vy" in found.message and "degrees of longitude" in found.fix


@pytest.mark.parametrize("place", PLACES)
def test_a_position_upside_down_blocks(place: str) -> None:
    raw, vehicle = flown(place)
    assert check([signs("z")(raw)], vehicle).blocking


@pytest.mark.parametrize("seconds", [-0.4, seldom(-0.2), 0.1, *map(seldom, (0.15, 0.2, 0.3)), 0.4])
def test_a_delay_of_up_to_half_a_second_is_found_and_is_no_sign(seconds: float) -> None:
    raw, vehicle = flown("outdoor")
    report = check([late(seconds, P, V)(raw)], vehicle)
    (found,) = report.of("acceleration")
    assert report.ok and found.severity == "warning"
    assert found.evidence["delay_s"] == pytest.approx(seconds, abs=0.02)
    assert ("late" if seconds > 0 else "early") + " against specific force" in found.message


def test_a_delay_where_the_search_ends_is_no_estimate() -> None:
    raw, vehicle = flown("outdoor")
    report = check([late(0.53, P, V)(raw)], vehicle)
    (found,) = report.of("acceleration")
    assert report.ok
    assert "late against specific force by about 500 ms or more" in found.message
    assert "which is no estimate" in found.message
