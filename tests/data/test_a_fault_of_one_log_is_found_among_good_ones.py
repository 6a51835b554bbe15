"""A log's columns, units, frames and wiring are its own: what blocks a log alone blocks it among good
ones, too, and says nothing of these."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import pytest
from faults import conjugated, exchanged, real, scaled, vehicle

from greybox.data import RawLog
from greybox.data.checks import check
from greybox.data.checks.together import alone_and_together

SET = "nanobench"
GOOD = ("B2_circle_slow_rep1", "B3_figure8_fast_rep1", "B8_star_fast_rep3")
FLIGHT = "B2_circle_medium_rep1"

FAULTS: dict[str, Callable[[RawLog], RawLog]] = {
    "motors": lambda raw: exchanged(raw, "u1", "u2"),
    "gyro in deg/s": lambda raw: scaled(raw, "p q r", 57.29578),
    "gyro axes": lambda raw: exchanged(raw, "p", "q"),
    "quaternion": conjugated,
    "position in mm": lambda raw: scaled(raw, "x y z", 1000.0),
    "accelerometer in g": lambda raw: scaled(raw, "ax ay az", 1 / 9.80665),
}


def some(*faults: str) -> list[object]:
    """These of all in every run, the others in the slow ones."""
    return [f if f in faults else pytest.param(f, marks=pytest.mark.slow) for f in FAULTS]


@pytest.mark.parametrize("fault", some("motors", "gyro axes", "position in mm"))
def test_a_fault_is_found_among_good_logs_and_is_theirs_not(fault: str) -> None:
    bad = FAULTS[fault](real(SET, FLIGHT))
    alone = check([bad], vehicle(SET)).blocking
    among = check([*(real(SET, f) for f in GOOD), bad], vehicle(SET)).blocking
    assert alone
    assert {f.flight for f in among} == {FLIGHT}
    assert {f.check for f in among} == {f.check for f in alone}


@pytest.mark.parametrize("fault", some("motors", "quaternion"))
def test_two_logs_with_the_fault_do_not_hide_it_behind_a_good_one(fault: str) -> None:
    others = [FAULTS[fault](real(SET, f)) for f in GOOD[1:]]
    report = check([real(SET, GOOD[0]), *others], vehicle(SET))
    assert {f.flight for f in report.blocking} == set(GOOD[1:])


def test_a_column_that_is_lost_is_named_with_what_goes_with_it() -> None:
    raw = real(SET, FLIGHT)
    channels = {n: v for n, v in raw.channels.items() if n != "p"}
    report = check([replace(raw, channels=channels), real(SET, GOOD[0])], vehicle(SET))
    line = next(said for said in report.warning_lines() if "[gaps]" in said)
    assert line.startswith(f"{FLIGHT} [gaps] channel p: column imu_gyro_x is missing")
    assert "the rate (p, q, r) is left out" in line


def judged(numbers: Sequence[float]) -> str | None:
    """ "high" and "low" are sure, "odd" is not."""
    mean = sum(numbers) / len(numbers)
    return "high" if mean > 3 else "low" if mean < -3 else "odd" if abs(mean) > 1 else None


def told(**flights: float) -> set[tuple[str, tuple[str, ...], int]]:
    found = alone_and_together(flights, judged, claim=str, sure=lambda said: said != "odd")
    return {(one.said, one.flights, one.others) for one in found}


def test_what_a_flight_alone_is_sure_of_is_its_own_and_does_not_weigh_on_the_others() -> None:
    assert told(a=0.0, b=0.0, c=100.0) == {("high", ("c",), 2)}
    assert told(a=9.0, b=-9.0) == {("high", ("a",), 0), ("low", ("b",), 0)}


def test_flights_that_say_the_same_are_told_it_once() -> None:
    assert told(a=9.0, b=0.0, c=4.0) == {("high", ("a", "c"), 1)}


def test_flights_that_are_not_sure_alone_are_judged_together() -> None:
    assert told(a=2.0, b=2.0, c=0.0) == {("odd", ("a",), 1), ("odd", ("b",), 1)}
    assert told(a=2.0, b=2.0) == {("odd", ("a", "b"), 0)}
    assert told(a=0.0, b=0.0) == set()
