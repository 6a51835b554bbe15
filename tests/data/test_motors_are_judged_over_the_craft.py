"""One craft has one motor order: it is judged over all flights, and a flight that differs is
named."""

from __future__ import annotations

from dataclasses import replace

from greybox.data.checks import check
from tests.data.faults import exchanged, real, vehicle

SET = "nanobench"
FLIGHTS = ("B2_circle_medium_rep1", "B2_circle_slow_rep1", "B3_figure8_fast_rep1")


def test_all_flights_are_told_the_same() -> None:
    flights = [exchanged(real(SET, f), "u1", "u2") for f in FLIGHTS]
    found = check(flights, vehicle(SET)).of("motors")
    assert [f.flight for f in found] == list(FLIGHTS)
    assert len({f.message for f in found}) == 1
    assert all(f.severity == "blocking" and f.evidence["flights"] == 3 for f in found)
    assert "u1 drives rotor 2, u2 drives rotor 1" in found[0].message


def test_one_flight_with_another_order_is_named_and_does_not_condemn_the_craft() -> None:
    flights = [real(SET, f) for f in FLIGHTS[1:]] + [exchanged(real(SET, FLIGHTS[0]), "u1", "u2")]
    found = check(flights, vehicle(SET)).of("motors")
    assert {(f.flight, f.severity) for f in found} == {(FLIGHTS[0], "blocking")}
    assert "u1 drives rotor 2, u2 drives rotor 1" in found[0].message
    assert "2 other flight(s) do not show it" in found[0].message


def test_wrong_frames_are_not_also_a_wrong_motor_order() -> None:
    raw = real(SET, FLIGHTS[0])
    channels = {**raw.channels, "p": raw.channels["q"], "q": raw.channels["p"]}
    report = check([replace(raw, channels=channels)], vehicle(SET))
    assert {f.check for f in report.blocking} == {"attitude"}
    assert not report.of("motors")


def test_a_flight_whose_gyro_is_wrong_does_not_judge_the_motors_of_the_others() -> None:
    raw = real(SET, FLIGHTS[0])
    channels = {**raw.channels, "p": raw.channels["q"], "q": raw.channels["p"]}
    flights = [real(SET, f) for f in FLIGHTS[1:]]
    report = check([*flights, replace(raw, channels=channels)], vehicle(SET))
    assert {(f.flight, f.check) for f in report.blocking} == {(FLIGHTS[0], "attitude")}
    assert not report.of("motors")
