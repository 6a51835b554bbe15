"""A log with an attitude and commands, but no gyro, tells which command drives which rotor: body
rates follow from the attitude, noisy, rounded, slow or late as it may be."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from greybox.data import RawLog
from greybox.data.checks import CheckReport, check
from greybox.data.checks.rates import body_rates, shown_by, windows
from greybox.data.checks.signals import smoothed
from greybox.data.checks.view import View
from greybox.examples import flight_paths
from tests.data.faults import exchanged, real, vehicle, with_channels

SET = "nanobench"
IMU = ("p", "q", "r", "ax", "ay", "az")
POSE = ("x", "y", "z", "vx", "vy", "vz", "qw", "qx", "qy", "qz")
QUATERNION = POSE[6:]
FLIGHTS = tuple(p.name.removesuffix(".csv.gz") for p in flight_paths(SET))
CALM = "B7_oval_medium_rep2"


def posed(flight: str) -> RawLog:
    """The flight as its pose and commands alone."""
    raw = real(SET, flight)
    kept = {n: v for n, v in raw.channels.items() if n not in IMU}
    return replace(raw, channels=kept, extra={})


def told(*logs: RawLog) -> CheckReport:
    return check(logs, vehicle(SET))


def taken(raw: RawLog, rows: slice) -> RawLog:
    channels = {n: v[rows] for n, v in raw.channels.items()}
    return replace(raw, t=raw.t[rows], rows=raw.rows[rows], channels=channels)


def noisy(raw: RawLog) -> RawLog:
    """Half a degree of noise in every sample."""
    rng = np.random.default_rng(1)
    q = np.column_stack([raw.channels[n] for n in QUATERNION])
    q = q + 0.004 * rng.standard_normal(q.shape)
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    return with_channels(raw, **dict(zip(QUATERNION, q.T, strict=True)))


def rounded(raw: RawLog) -> RawLog:
    return with_channels(raw, **{n: np.round(raw.channels[n], 3) for n in QUATERNION})


def in_every_fourth_row(raw: RawLog) -> RawLog:
    there = np.arange(raw.n) % 4 == 0
    return with_channels(raw, **{n: np.where(there, raw.channels[n], np.nan) for n in POSE})


def late(raw: RawLog) -> RawLog:
    """The pose 100 ms late."""
    moved = with_channels(raw, **{n: np.roll(raw.channels[n], 10) for n in POSE})
    return taken(moved, slice(10, None))


LOGS: dict[str, Callable[[RawLog], RawLog]] = {
    "as it came": lambda raw: raw,
    "no velocity": lambda raw: replace(
        raw, channels={n: v for n, v in raw.channels.items() if n not in POSE[3:6]}
    ),
    "noisy": noisy,
    "rounded": rounded,
    "25 Hz": lambda raw: taken(raw, slice(None, None, 4)),
    "25 Hz in rows of 100 Hz": in_every_fourth_row,
    "late": late,
}


def rows(*fast: str) -> pytest.MarkDecorator:
    """The calm flight in all ways, and the fast one in these; in the others in the slow tests."""
    found = [pytest.param(CALM, log, id=f"{name}-{CALM}") for name, log in LOGS.items()]
    for name, log in LOGS.items():
        marks = () if name in fast else pytest.mark.slow
        found.append(pytest.param("B8_star_fast_rep2", log, id=f"{name}-fast", marks=marks))
    return pytest.mark.parametrize(("flight", "log"), found)


@rows("noisy", "late")
def test_exchanged_motors_are_found(flight: str, log: Callable[[RawLog], RawLog]) -> None:
    report = told(log(exchanged(posed(flight), "u1", "u2")))
    found = report.of("motors")
    assert [f.severity for f in found] == ["blocking"]
    assert "u1 drives rotor 2, u2 drives rotor 1" in found[0].message
    assert "motors" not in report.summary().splitlines()[0].partition("not judged: ")[2]


@rows("noisy", "25 Hz")
def test_motors_in_their_order_are_none(flight: str, log: Callable[[RawLog], RawLog]) -> None:
    report = told(log(posed(flight)))
    assert report.blocking == ()
    assert not report.of("motors")
    assert not [f for f in report.of("alignment") if f.severity != "info"]


@pytest.mark.parametrize(
    "flights", [FLIGHTS[::3], pytest.param(FLIGHTS, marks=pytest.mark.slow)], ids=["some", "all"]
)
def test_real_flights_are_judged_by_their_attitude_and_none_is_accused(flights) -> None:
    report = told(*(posed(f) for f in flights))
    assert report.blocking == ()
    assert not report.of("motors")
    assert not [u for u in report.not_judged if u.check == "motors" and not u.part]
    assert report.unchecked_order == []


@pytest.mark.parametrize(
    "flight",
    [f if i % 3 == 0 else pytest.param(f, marks=pytest.mark.slow) for i, f in enumerate(FLIGHTS)],
)
def test_parts_of_a_few_seconds_accuse_nobody(flight: str) -> None:
    report = told(taken(posed(flight), slice(500, 1000)))
    assert not report.of("motors")
    assert not [f for f in report.of("alignment") if f.severity != "info"]


def test_a_wrong_attitude_is_no_wrong_motor_order() -> None:
    raw = posed("B8_star_fast_rep2")
    wrong = with_channels(raw, **{n: -raw.channels[n] for n in QUATERNION[1:]})
    report = told(wrong)
    assert {f.check for f in report.blocking} == {"acceleration"}
    assert not report.of("motors")
    assert "motors" in {u.check for u in report.not_judged}


def spun() -> tuple[RawLog, np.ndarray]:
    """(a log of an attitude that turns about all axes at once, its body rates (N, 3) [rad/s])."""
    t = np.arange(0.0, 10.0, 0.01)
    rates = np.column_stack([np.sin(3.0 * t), 2.0 * np.cos(2.0 * t), 1.0 + np.sin(t)])
    turns = [Rotation.from_rotvec(0.01 * w) for w in 0.5 * (rates[1:] + rates[:-1])]
    steps = itertools.accumulate(
        turns, lambda so_far, turn: so_far * turn, initial=Rotation.identity()
    )
    q = np.array([r.as_quat()[[3, 0, 1, 2]] for r in steps])
    channels = {f"u{i}": np.full(t.size, 0.6) for i in range(1, 5)}
    channels |= dict(zip(QUATERNION, q.T, strict=True))
    rows = np.arange(1, t.size + 1)
    raw = replace(posed(CALM), t=t, rows=rows, channels=channels)
    return raw, rates


def test_the_rates_of_the_attitude_are_those_of_the_gyro() -> None:
    raw, rates = spun()
    measured = with_channels(raw, **dict(zip("pqr", rates.T, strict=True)))
    by_gyro, by_attitude = (View(raw=r, vehicle=vehicle(SET)) for r in (measured, raw))
    assert (shown_by(by_gyro), shown_by(by_attitude)) == ("rate", "attitude")
    assert len(windows(by_gyro)) == 1 and len(windows(by_attitude)) > 1
    for half in windows(by_attitude):
        (gyro, none), (found, mean) = (body_rates(v, half) for v in (by_gyro, by_attitude))
        assert (none, mean) == (0, half)
        known = np.isfinite(found).all(axis=1)
        assert known.sum() == raw.n - 2 * half
        over = smoothed(gyro, half)[known]
        assert np.abs(found[known] - over).max() < 0.05
