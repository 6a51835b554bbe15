"""One craft has one motor order: it is judged over all flights, and a flight that differs is
named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greybox.data.checks import check
from tests.data.faults import exchanged, real, scaled, vehicle
from tests.hardening.channel_faults import A, W, linear, tilted, yaw

SET = "nanobench"
FLIGHTS = ("B2_circle_medium_rep1", "B2_circle_slow_rep1", "B3_figure8_fast_rep1")


def test_all_flights_are_told_the_same() -> None:
    flights = [exchanged(real(SET, f), "u1", "u2") for f in FLIGHTS]
    found = check(flights, vehicle(SET)).of("motors")
    assert [f.flight for f in found] == list(FLIGHTS)
    assert len({f.message for f in found}) == 1
    assert all(f.severity == "blocking" and f.evidence["flights"] == 3 for f in found)
    assert "u1 drives rotor 2, u2 drives rotor 1" in found[0].message


@pytest.mark.parametrize("angle", [45.0, -45.0, 135.0])
def test_a_plus_that_was_taken_for_an_x_is_a_turned_layout(angle: float) -> None:
    """Turned by half the angle between two rotors the torques agree by half, which alone looks
    right."""
    craft, (c, s) = vehicle(SET), (np.cos(np.radians(angle)), np.sin(np.radians(angle)))
    rotors = tuple(
        replace(r, position=(c * x - s * y, s * x + c * y, z))
        for r in craft.rotors
        for x, y, z in (r.position,)
    )
    found = check([real(SET, f) for f in FLIGHTS], replace(craft, rotors=rotors)).of("motors")
    assert [f.flight for f in found] == list(FLIGHTS)
    assert all(f.severity == "blocking" and "as in X for +" in f.message for f in found)
    assert all("turn them by 45 deg" in f.fix for f in found)


@pytest.mark.parametrize("degrees", [45.0, -45.0])
def test_a_board_that_is_yawed_is_named_beside_the_layout(degrees: float) -> None:
    """Gyro, accelerometer and attitude of a board that sits askew on the craft give the torques of
    a turned layout: which of both it is the log does not tell."""
    flights = [linear(yaw(degrees), W, A)(real(SET, f)) for f in FLIGHTS]
    askew = tilted((0.0, 0.0, -np.radians(degrees)), left=False)
    found = check([askew(raw) for raw in flights], vehicle(SET)).of("motors")
    assert [f.flight for f in found] == list(FLIGHTS)
    assert all("as in X for +" in f.message for f in found)
    assert all("[[rotor]]" in f.fix and "or the axes of the gyro" in f.fix for f in found)


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


def test_a_body_that_is_turned_round_is_one_fault_and_not_a_motor_order_too() -> None:
    """All axes forward, right, down: the gyro agrees with the attitude, and following both findings
    would break the second."""
    raw = real(SET, FLIGHTS[0])
    there = [
        n for n in ("q", "r", "qy", "qz", "ay", "az", "y", "z", "vy", "vz") if n in raw.channels
    ]
    report = check([scaled(raw, " ".join(there), -1.0)], vehicle(SET))
    assert {f.check for f in report.blocking} == {"gravity"}
    assert "motors" in {u.check for u in report.not_judged}
    assert "motors" in report.summary().splitlines()[0].partition("not judged: ")[2]
    gyro_alone = exchanged(raw, "u1", "u2")
    assert check([gyro_alone], vehicle(SET)).of("motors")


def test_columns_that_look_like_a_gyro_are_named_where_there_is_none() -> None:
    raw = real(SET, FLIGHTS[0])
    others = {n: v for n, v in raw.channels.items() if n not in ("p", "q", "r")}
    extra = {f"gyro_{a}": raw.channels[n] for a, n in zip("xyz", "pqr", strict=True)}
    report = check([replace(raw, channels=others, extra=extra)], vehicle(SET))
    said = {u.check: u.reason for u in report.not_judged}
    for name in ("attitude", "alignment"):
        assert said[name].startswith("no gyro, but gyro_x, gyro_y, gyro_z look like one")
    still = {n: v for n, v in others.items() if not n.startswith("q")}
    turning = check([replace(raw, channels=still, extra=extra)], vehicle(SET))
    said = {u.check: u.reason for u in turning.not_judged}
    assert said["motors"].startswith("no gyro, but gyro_x, gyro_y, gyro_z look like one")
    bare = check([replace(raw, channels=still, extra={})], vehicle(SET))
    assert {u.reason for u in bare.not_judged if u.check == "motors"} == {"no gyro"}
