"""Position, velocity, attitude, rates and specific force are held against each other: a fault of
one is named by it.

The whole table of faults is `python -m tests.hardening.fault_table`; here stand one of each kind,
on a real flight.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from greybox.data.channel import group_names
from greybox.data.checks import check
from greybox.data.checks.finding import CheckReport
from greybox.data.checks.kinematics import common_rate
from greybox.data.checks.mixture import mixture
from greybox.data.checks.relations import (
    CLEAR,
    Factor,
    Reading,
    Tried,
    better_reading,
    jackknife,
    mixed,
    moments,
    nearer,
)
from greybox.data.checks.signals import Integral, turned
from greybox.data.checks.spans import spans
from greybox.data.raw import RawLog
from greybox.data.readers.assemble import other_frame
from tests.data.faults import real, vehicle
from tests.hardening.channel_faults import CHANNEL_FAULTS

SET, FLIGHT = "nanobench", "B2_circle_medium_rep1"


@functools.cache
def faulty(name: str) -> CheckReport:
    return check([CHANNEL_FAULTS[name].make(real(SET, FLIGHT))], vehicle(SET))


def messages(name: str, severity: str, of: str) -> list[str]:
    return [f.message for f in faulty(name).of(of) if f.severity == severity]


@pytest.mark.parametrize(
    ("name", "of", "words"),
    [
        ("velocity in body axes", "motion", "only when the velocity is in body axes"),
        (
            "x and y of position and velocity swapped",
            "acceleration",
            "the world's x = y, y = the world's x",
        ),
        ("x and y of the position swapped", "motion", "vx = vy, vy = vx (explains"),
        ("motion capture yawed by 90 deg", "acceleration", "the world's x = -y, y = the world's x"),
        ("motion capture yawed by 30 deg", "acceleration", "turned by 30 deg about z"),
        ("accelerometer in world axes", "acceleration", "the specific force is in world axes"),
        ("attitude tilted by 10 deg in the world", "gravity", "10 deg from the world's up"),
        ("r negated", "attitude", "r = -r"),
        ("gyro in world axes", "attitude", "the gyro is in world axes"),
        ("position in km", "motion", "the position moves 0.000999 times"),
        ("clock 10 % slow", "clock", "the time runs 1.1 times as fast as the motion"),
        ("2 s cut out, clock closed up", "jumps", "rows are missing there, but the clock goes on"),
        ("1 s comes twice", "jumps", "100 rows from t = "),
    ],
)
def test_a_fault_that_nothing_else_explains_blocks(name: str, of: str, words: str) -> None:
    assert any(words in m for m in messages(name, "blocking", of))


@pytest.mark.parametrize(
    ("name", "of", "words"),
    [
        ("gyro times 1.2", "attitude", "the attitude turns 0.8"),
        ("accelerometer times 1.1", "acceleration", "the velocity changes 0.8"),
        ("position times 1.08", "motion", "the position moves 1.08 times"),
        ("velocity 100 ms late", "motion", "position is 100 ms early against velocity"),
        ("position jumps by 0.5 m", "jumps", "the position jumps at t = "),
        ("one sample of the accelerometer", "ranges", "1 sample(s) taken as missing"),
        ("battery of 0 V for five samples", "ranges", "5 value(s) outside"),
    ],
)
def test_a_factor_a_delay_or_a_lone_sample_is_said(name: str, of: str, words: str) -> None:
    assert any(words in m for m in messages(name, "warning", of))
    assert faulty(name).ok


def test_a_factor_of_two_blocks() -> None:
    assert any("0.50" in m for m in messages("gyro times 2", "blocking", "attitude"))


def test_nothing_is_said_of_the_flight_as_it_came() -> None:
    report = check([real(SET, FLIGHT)], vehicle(SET))
    assert {f.check for f in report.findings if f.severity != "info"} == {"alignment"}


def read_as(raw: RawLog, group: str, frame: str, how: Callable[[np.ndarray], np.ndarray]) -> RawLog:
    """The flight whose columns of a group, logged in that frame, are read wrongly."""
    names = group_names(group)
    logged = other_frame(np.column_stack([raw.channels[n] for n in names]), group, frame)
    read = other_frame(how(logged), group, frame)
    return replace(raw, channels={**raw.channels, **{n: read[:, i] for i, n in enumerate(names)}})


@pytest.mark.parametrize("frame", [pytest.param("FLU/ENU", marks=pytest.mark.slow), "FRD/NED"])
@pytest.mark.parametrize(
    ("how", "words"),
    [
        (lambda q: q * [1.0, -1.0, -1.0, -1.0], "the quaternion turns world into body: negate"),
        (lambda q: q[:, [1, 2, 3, 0]], "the scalar comes last: the columns hold x, y, z, w"),
        (lambda q: q[:, [3, 0, 1, 2]], "the columns named qx, qy, qz, qw hold w, x, y, z"),
    ],
)
def test_a_quaternion_read_wrongly_is_named_in_whatever_frame_it_is_logged(
    how: Callable[[np.ndarray], np.ndarray], words: str, frame: str
) -> None:
    report = check([read_as(real(SET, FLIGHT), "attitude", frame, how)], vehicle(SET))
    for of in ("attitude", "acceleration"):
        (found,) = report.of(of)
        assert words in found.message and "[columns.attitude]" in found.fix


def test_an_accelerometer_upside_down_accuses_no_world_frame() -> None:
    raw = real(SET, FLIGHT)
    turned_over = {n: -raw.channels[n] for n in ("ay", "az", "q", "r")}
    report = check([replace(raw, channels={**raw.channels, **turned_over})], vehicle(SET))
    assert any("thrust acts along -z" in f.message for f in report.of("gravity"))
    assert not report.of("acceleration")
    assert any(u.check == "acceleration" and "see gravity" in u.reason for u in report.not_judged)


@pytest.mark.parametrize("left", [(0.1, 0.0, 0.0), (0.0, 0.0, -0.1), (0.0, 0.0, 0.1)])
def test_without_gravity_neither_axes_nor_a_world_are_accused(
    left: tuple[float, float, float],
) -> None:
    """The mean force is chance then, and so is its largest axis: "not up" would be said of a z that
    is."""
    raw, craft = real(SET, FLIGHT), vehicle(SET)
    force = {
        n: raw.channels[n] - np.nanmean(raw.channels[n]) + bias
        for n, bias in zip(("ax", "ay", "az"), left, strict=True)
    }
    report = check([replace(raw, channels={**raw.channels, **force})], craft)
    assert any("gravity was taken out" in f.message for f in report.of("gravity"))
    assert not report.of("acceleration")
    reasons = [u.reason for u in report.not_judged if u.check == "acceleration"]
    assert reasons == ["the force has no lasting direction (see gravity)"]


@pytest.mark.parametrize(
    ("body", "world"),
    [
        ("FRD", "NED"),
        *(pytest.param(b, "ENU", marks=pytest.mark.slow) for b in ("FLU", "FRD")),
    ],
)
def test_a_velocity_in_body_axes_is_named_whatever_world_it_was_taken_for(
    body: str, world: str
) -> None:
    raw = real(SET, FLIGHT)
    q = np.column_stack([raw.channels[n] for n in ("qw", "qx", "qy", "qz")])
    v = np.column_stack([raw.channels[n] for n in ("vx", "vy", "vz")])
    logged = other_frame(turned("rotate_inverse", q, v), "velocity", body)
    taken = other_frame(logged, "velocity", world)
    made = {n: taken[:, i] for i, n in enumerate(("vx", "vy", "vz"))}
    report = check([replace(raw, channels={**raw.channels, **made})], vehicle(SET))
    for of in ("motion", "acceleration"):
        (found,) = report.of(of)
        assert found.severity == "blocking" and "velocity is in body axes" in found.message
        assert f"frame = '{body}' in [columns.velocity]" in found.fix


@pytest.mark.parametrize("power", [1.0, -1.0])
def test_a_rate_of_the_clock_explains_all_factors_or_is_not_said(power: float) -> None:
    def said(*ranges: tuple[float, float]) -> float | None:
        factors = [Factor(value=float(np.sqrt(a * b)), low=a, high=b) for a, b in ranges]
        return common_rate([f.to_the(power) for f in factors])

    # The accelerometer has a scale of its own, and the gyro's range is wide.
    rate = said((1.0495, 1.0505), (1.053, 1.064), (0.95, 1.2))
    assert rate is not None and abs(rate - 1.054**power) < 0.002
    assert said((0.999, 1.001), (1.053, 1.064), (0.95, 1.2)) is None
    assert said((1.001, 1.002), (1.051, 1.056), (1.001, 1.003)) is None
    assert said((1.053, 1.064), (0.95, 1.2)) is None
    assert said((1.01, 1.02), (1.01, 1.02), (1.01, 1.02)) is None
    assert said((1.19, 1.21), (1.06, 1.07), (1.06, 1.07)) is None


def gappy(raw: RawLog, share: float, names: str) -> RawLog:
    """The flight with a share of its cells missing at random, in the same rows of all `names`."""
    lost = np.random.default_rng(7).random(raw.n) < share
    return replace(
        raw,
        channels={
            **raw.channels,
            **{n: np.where(lost, np.nan, raw.channels[n]) for n in names.split()},
        },
    )


@pytest.mark.parametrize(
    ("names", "fault"),
    [
        pytest.param(names, fault, marks=() if its else pytest.mark.slow)
        for fault, own in (("accelerometer", "ax ay az"), ("gyro", "p q r"))
        for names in ("qw qx qy qz", "p q r", "ax ay az", "vx vy vz")
        for its in [names == own or (fault == "gyro" and names == "qw qx qy qz")]
    ],
)
def test_a_few_missing_samples_hide_no_fault_and_make_none(names: str, fault: str) -> None:
    fault = f"{fault} in world axes"
    clean = check([gappy(real(SET, FLIGHT), 0.05, names)], vehicle(SET))
    assert {f.check for f in clean.findings if f.severity != "info"} == {"alignment"}
    assert {u.check for u in clean.not_judged} == {u.check for u in faulty(fault).not_judged} - {
        "motors"
    }
    broken = check(
        [gappy(CHANNEL_FAULTS[fault].make(real(SET, FLIGHT)), 0.05, names)], vehicle(SET)
    )
    said = {(f.check, f.message.partition(" (")[0]) for f in broken.blocking}
    assert said == {(f.check, f.message.partition(" (")[0]) for f in faulty(fault).blocking}


def test_a_check_that_gaps_forbid_says_so_and_not_that_the_flight_is_short() -> None:
    raw = real(SET, FLIGHT)
    holes = np.arange(raw.n) % 40 < 18
    names = ("qw", "qx", "qy", "qz")
    made = replace(
        raw,
        channels={**raw.channels, **{n: np.where(holes, np.nan, raw.channels[n]) for n in names}},
    )
    report = check([made], vehicle(SET))
    (reason,) = [u.reason for u in report.not_judged if u.check == "acceleration"]
    assert "too many gaps" in reason and "too short" not in reason
    (said,) = [f for f in report.of("gaps") if "cells are empty" in f.message]
    assert "45 % of qw, qx, qy, qz" in said.message


@pytest.mark.parametrize(
    ("every", "lost", "said"),
    [pytest.param(2, 0.0, 0, marks=pytest.mark.slow), (4, 0.0, 0), (2, 0.3, 1)],
)
def test_a_channel_at_a_pace_of_its_own_misses_nothing(every: int, lost: float, said: int) -> None:
    """Motion capture on every second row; what it loses of its own samples is said."""
    raw = real(SET, FLIGHT)
    rows = np.arange(raw.n)
    keep = (rows % every == 0) & (np.random.default_rng(1).random(raw.n) >= lost)
    names = ("qw", "qx", "qy", "qz", "x", "y", "z")
    slow = {n: np.where(keep, raw.channels[n], np.nan) for n in names}
    report = check([replace(raw, channels={**raw.channels, **slow})], vehicle(SET))
    found = [f for f in report.of("gaps") if "cells are empty" in f.message]
    assert len(found) == said
    for f in found:
        assert f.evidence["missing_share_x"] == pytest.approx(lost, abs=0.03)


def off_centre(raw: RawLog, place: np.ndarray) -> RawLog:
    """The flight as a mark at `place` [m] from the centre of mass moves."""
    q = np.column_stack([raw.channels[n] for n in ("qw", "qx", "qy", "qz")])
    moved = turned("rotate", q, np.tile(place, (len(q), 1)))
    added = np.gradient(moved, raw.t, axis=0)
    more = {n: raw.channels[n] + moved[:, i] for i, n in enumerate("xyz")}
    more |= {n: raw.channels[n] + added[:, i] for i, n in enumerate(("vx", "vy", "vz"))}
    return replace(raw, channels={**raw.channels, **more})


def test_a_mark_off_the_centre_of_mass_is_no_turned_world_and_hides_none() -> None:
    raw = off_centre(real(SET, "B2_circle_fast_rep1"), np.array([0.3, 0.1, 0.3]))
    assert not list(check([raw], vehicle(SET)).of("acceleration"))
    turned_by_30 = CHANNEL_FAULTS["motion capture yawed by 30 deg"].make(raw)
    (found,) = check([turned_by_30], vehicle(SET)).of("acceleration")
    assert found.severity == "blocking" and "deg about z" in found.message


def test_a_rounded_scalar_of_a_hover_is_no_frozen_sensor() -> None:
    raw = real(SET, FLIGHT)
    rounded = {n: np.round(raw.channels[n], 2) for n in ("qw", "qx", "qy", "qz")}
    still = {"qw": np.where(np.arange(raw.n) % 400 < 100, 1.0, raw.channels["qw"])}
    for change in (rounded, still):
        made = type(raw)(**{**vars(raw), "channels": {**raw.channels, **change}})
        assert not [f for f in check([made], vehicle(SET)).of("frozen") if f.severity == "blocking"]


@pytest.mark.parametrize("truth", [0.0, 1.0])
def test_mounting_and_factors_do_not_hide_which_reading_is_true(truth: float) -> None:
    draw = np.random.default_rng(3)
    x, other = draw.normal(size=(2, 400, 3))
    other = x + 0.05 * other
    m = np.eye(3) + 0.2 * draw.normal(size=(3, 3))
    y = (x + truth * (other - x)) @ m.T + 0.1 * draw.normal(size=x.shape)
    weight, others = mixture(y, x, other, np.arange(0, 400, 40)).weights()
    error = np.sqrt(0.9 * ((others - others.mean()) ** 2).sum())
    assert abs(weight - truth) < 4.0 * error < 0.6


def test_readings_that_differ_by_a_constant_matrix_are_not_told_apart_by_the_way_between_them() -> (
    None
):
    x = np.random.default_rng(3).normal(size=(400, 3))
    weight, _ = mixture(x, x, x @ np.diag([1.0, -1.0, 0.5]), np.arange(0, 400, 40)).weights()
    assert np.isnan(weight)


@pytest.mark.parametrize(("true_share", "told"), [(0.0, False), (1.0, True)])
def test_noise_that_no_reading_knows_stands_halfway_and_accuses_none(
    true_share: float, told: bool
) -> None:
    """Where an accelerometer feels little but its own noise across the thrust, exchanged axes miss
    as much as the right ones; what else is left of the motion then tips the scales."""
    draw = np.random.default_rng(7)
    x, felt, noise = draw.normal(size=(3, 4000, 3))
    felt, noise = 0.05 * felt, 0.05 * noise
    turn = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    given = x + true_share * felt + noise
    other = x + (true_share * felt + noise) @ turn.T
    y = x + true_share * felt @ turn.T + 0.03 * (other - given)
    y += 0.002 * draw.normal(size=x.shape)
    between = mixture(y, given, other, np.arange(0, 4000, 200))
    weight, others = between.weights()
    assert weight - 0.5 > CLEAR * jackknife(others)
    assert nearer(between) is told


def summed(increments: np.ndarray) -> Integral:
    """What has these increments (N, 3) from each row to the next."""
    total = np.vstack([np.zeros((1, 3)), np.cumsum(increments, axis=0)])
    return Integral(total=total, lost=np.zeros(len(total), dtype=np.int64))


@pytest.mark.parametrize(("apart", "told"), [(0.01, False), (0.1, True)])
def test_readings_that_differ_by_less_than_sensors_resolve_are_not_told_apart(
    apart: float, told: bool
) -> None:
    """What sensors leave, here 0.1 % of the motion, may look like a step to a reading that differs
    by less."""
    draw = np.random.default_rng(5)
    x, d = draw.normal(size=(2, 2000, 3))
    y = x + 0.9 * apart * d + 0.03 * draw.normal(size=x.shape)
    at = spans(np.zeros((2001, 1)), 1)
    readings = [
        Reading(text=t, fix="", y=y, x=summed(z)) for t, z in (("", x), ("another", x + apart * d))
    ]
    tried = []
    for r in readings:
        sums = moments(r, at, 0.01, np.array([0]), np.array([0]))
        assert sums is not None
        tried.append(
            Tried(text=r.text, fix="", sums=sums, mixed=mixed(readings[0], r, at, 0.01, 0.0))
        )
    assert tried[1].sums.total.share(np.eye(3)) > tried[0].sums.total.share(np.eye(3)) > 0.98
    assert (better_reading(tried, ("ax", "ay", "az"), "") is not None) is told
