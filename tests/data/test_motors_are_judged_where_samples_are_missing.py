"""Which command drives which rotor is seen where the gyro has holes or is slower than the commands;
where it cannot be seen, neither `check` nor `fit` passes over that."""

from __future__ import annotations

import numpy as np
import pytest

from greybox.data import RawLog
from greybox.data.checks import CheckReport, check
from tests.data.faults import exchanged, real, vehicle, with_channels

GYRO = ("p", "q", "r")


def flight() -> RawLog:
    return real("nanobench", "B8_star_fast_rep2")


def with_holes(raw: RawLog, share: float) -> RawLog:
    """That share of the cells of the gyro empty, each by its own."""
    draw = np.random.default_rng(3)
    empty = {n: draw.random(raw.n) < share for n in GYRO}
    return with_channels(raw, **{n: np.where(empty[n], np.nan, raw.channels[n]) for n in GYRO})


def every(raw: RawLog, rows: int) -> RawLog:
    """The gyro in every so many rows alone."""
    there = np.arange(raw.n) % rows == 0
    return with_channels(raw, **{n: np.where(there, raw.channels[n], np.nan) for n in GYRO})


LOGS = {
    "whole": lambda raw: raw,
    "holes": lambda raw: with_holes(raw, 0.1),
    "many holes": lambda raw: with_holes(raw, 0.3),
    "half as fast": lambda raw: every(raw, 2),
    "a third as fast": lambda raw: every(raw, 3),
}


def judged(raw: RawLog) -> CheckReport:
    return check([raw], vehicle("nanobench"))


@pytest.mark.parametrize("log", LOGS.values(), ids=LOGS)
def test_exchanged_motors_are_found(log):
    found = judged(log(exchanged(flight(), "u1", "u2"))).of("motors")
    assert [f.severity for f in found] == ["blocking"]
    assert "u1 drives rotor 2, u2 drives rotor 1" in found[0].message


@pytest.mark.parametrize("log", LOGS.values(), ids=LOGS)
def test_motors_in_their_order_are_none(log):
    assert not judged(log(flight())).of("motors")


def test_a_log_that_cannot_tell_is_not_called_clean_and_a_fit_says_so():
    """A gyro in every tenth row of a 100 Hz log turns faster than it is seen."""
    report = judged(with_holes(flight(), 0.97))
    assert not report.of("motors")
    assert "motors" in report.summary().splitlines()[0].partition("not judged: ")[2]
    said = [w for w in report.warning_lines() if "the order of the motors was not checked" in w]
    assert len(said) == 1
    assert "too much is missing" in said[0]


def test_where_one_flight_tells_the_order_the_fit_says_nothing():
    report = check(
        [with_holes(flight(), 0.97), real("nanobench", "B8_star_fast_rep3")], vehicle("nanobench")
    )
    assert not any("order of the motors" in w for w in report.warning_lines())
