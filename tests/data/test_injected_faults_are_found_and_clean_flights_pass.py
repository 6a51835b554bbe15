"""Every fault put into a real flight gives the right finding; the flights as they came give no
blocking one."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from faults import (
    conjugated,
    exchanged,
    frozen,
    late,
    real,
    scalar_last,
    scaled,
    vehicle,
    with_channels,
    with_time,
    without_rows,
)

from greybox.data import Dataset, read_log, read_table
from greybox.data.checks import CHECKS, check, check_logs
from greybox.data.readers.mapping import mapping_of
from greybox.errors import DataError
from greybox.examples import SETS, flight_path, flight_paths

STAR, CIRCLE = ("nanobench", "B8_star_fast_rep2"), ("nanobench", "B2_circle_medium_rep1")
IMU = ("arpl_crazyflie", "log15")
DEGREES = 180 / np.pi


def blocking(raw, set_name, check_name, **changes):
    """Messages of the blocking findings of one check."""
    report = check([raw], replace(vehicle(set_name), **changes) if changes else vehicle(set_name))
    return [f.message for f in report.blocking if f.check == check_name]


@pytest.mark.parametrize("set_name", SETS)
def test_real_flights_have_no_blocking_finding(set_name):
    report = check_logs(flight_paths(set_name), vehicle(set_name))
    assert report.blocking == ()
    assert report.ok
    assert report.of("thrust") == ()
    assert not [u for u in report.not_judged if u.check == "thrust"]
    assert [
        f for f in report.of("ranges") if f.severity != "info"
    ] == []  # no sample is taken in flight
    assert len(report.flights) == len(flight_paths(set_name))


def test_what_an_imu_log_cannot_show_is_listed():
    report = check([real(*IMU)], vehicle(IMU[0]))
    assert {(u.check, u.reason) for u in report.not_judged} == {
        ("attitude", "no attitude"),
        ("alignment", "no attitude"),
        ("acceleration", "no attitude"),
        ("jumps", "no position, velocity or attitude"),
        ("motion", "no position with velocity"),
    }
    assert "cannot be judged: attitude (no attitude" in report.summary()


@pytest.mark.parametrize(
    ("fault", "check_name", "words"),
    [
        (lambda r: scaled(r, "p q r", DEGREES), "attitude", "deg/s"),
        (lambda r: scaled(r, "p q r", 1 / DEGREES), "attitude", "twice"),
        (lambda r: scaled(r, "q", -1.0), "attitude", "q = -q"),
        (lambda r: exchanged(r, "p", "q"), "attitude", "p = q, q = p"),
        (lambda r: scaled(r, "ax ay az", 1 / 9.81), "gravity", "in g"),
        (lambda r: scaled(r, "ax ay az", 9.81), "gravity", "twice"),
        (lambda r: scaled(r, "ax ay az", -1.0), "gravity", "along -z"),
        (lambda r: exchanged(r, "ax", "az"), "gravity", "along +x"),
        (
            lambda r: with_channels(r, az=r.channels["az"] - 9.81),
            "gravity",
            "gravity was taken out",
        ),
        (lambda r: scaled(r, "z vz", -1.0), "gravity", "z points down"),
        (conjugated, "attitude", "world into body"),
        (scalar_last, "attitude", "scalar comes last"),
        (lambda r: scalar_last(conjugated(r)), "attitude", "world into body"),
        (lambda r: scaled(r, "u1 u2 u3 u4", 65535.0), "ranges", "outside"),
        (lambda r: scaled(r, "qw qx qy qz", 2.0), "ranges", "unit length"),
        (lambda r: frozen(r, "p q r", 800, 1400), "frozen", "p, q, r keep the value"),
        (lambda r: with_time(r, r.t * 1e3), "clock", "hardly in seconds"),
        (lambda r: late(r, 12, "p q r ax ay az"), "alignment", "late against the attitude"),
        (lambda r: late(r, -12, "p q r ax ay az"), "alignment", "early against the attitude"),
    ],
)
def test_faults_of_full_logs(fault, check_name, words):
    assert any(words in m for m in blocking(fault(real(*CIRCLE)), CIRCLE[0], check_name))


PAIRS = list(itertools.combinations(range(1, 5), 2))


@pytest.mark.parametrize(
    ("flight", "a", "b"),
    [
        *((STAR, a, b) for a, b in PAIRS),
        (IMU, 1, 3),
        *(pytest.param(IMU, a, b, marks=pytest.mark.slow) for a, b in PAIRS if (a, b) != (1, 3)),
    ],
)
def test_exchanged_motors_are_named(flight, a, b):
    (message,) = blocking(exchanged(real(*flight), f"u{a}", f"u{b}"), flight[0], "motors")
    assert f"u{a} drives rotor {b}, u{b} drives rotor {a} " in message


@pytest.mark.parametrize("flight", [STAR, CIRCLE, IMU])
def test_spins_the_wrong_way_round(flight):
    rotors = tuple(replace(r, spin=-r.spin) for r in vehicle(flight[0]).rotors)
    (message,) = blocking(real(*flight), flight[0], "motors", rotors=rotors)
    assert "spins are the wrong way round" in message


@pytest.mark.parametrize(("factor", "words"), [(DEGREES, "deg/s"), (1 / DEGREES, "twice")])
def test_gyro_unit_without_an_attitude(factor, words):
    assert any(words in m for m in blocking(scaled(real(*IMU), "p q r", factor), IMU[0], "motors"))


@pytest.mark.parametrize(("rows", "seconds"), [(200, 0.2), (-150, -0.15)])
def test_commands_on_another_clock_without_an_attitude(rows, seconds):
    clean = check([real(*IMU)], vehicle(IMU[0])).of("alignment")[0].evidence["p_s"]
    report = check([late(real(*IMU), rows, "p q r ax ay az")], vehicle(IMU[0]))
    (finding,) = [f for f in report.blocking if f.check == "alignment"]
    assert finding.evidence["lag_s"] == pytest.approx(clean + seconds, abs=0.015)
    assert not report.of("motors")  # the order of the motors is not judged by that


@pytest.mark.parametrize(
    ("flight", "rows"),
    [
        (STAR, -12),
        (STAR, 3),
        *(
            pytest.param(*s, marks=pytest.mark.slow)
            for s in ((STAR, 5), (CIRCLE, -5), (CIRCLE, 12))
        ),
        (CIRCLE, -3),
    ],
)
def test_shift_of_a_stream_is_recovered_within_a_sample(flight, rows):
    def offset(raw):
        found = check([raw], vehicle(flight[0])).of("alignment")
        return next(f.evidence["offset_samples"] for f in found if "offset_samples" in f.evidence)

    assert offset(late(real(*flight), rows, "p q r")) - offset(real(*flight)) == pytest.approx(
        rows, abs=1.0
    )


def test_drift_of_a_stream_is_seen():
    raw = real("nanobench", "B8_star_medium_rep1")
    stretched = {
        n: np.interp(raw.t - 0.004 * (raw.t - raw.t[0]), raw.t, raw.channels[n]) for n in "pqr"
    }
    (before,), (after,) = (
        [
            f.evidence
            for f in check([r], vehicle("nanobench")).of("alignment")
            if "drift_s_per_s" in f.evidence
        ]
        for r in (raw, with_channels(raw, **stretched))
    )
    assert after["drift_s_per_s"] - before["drift_s_per_s"] == pytest.approx(0.004, abs=0.001)


def test_time_that_goes_back_and_stamps_that_repeat_name_the_row():
    raw = real(*CIRCLE)
    back, twice = raw.t.copy(), raw.t.copy()
    back[500:] -= 0.5
    twice[700] = twice[699]
    (one,) = [
        f
        for f in check([with_time(raw, back)], vehicle("nanobench")).blocking
        if f.check == "clock"
    ]
    assert "goes back" in one.message
    assert one.evidence["first_row"] == raw.rows[500]
    (two,) = [
        f
        for f in check([with_time(raw, twice)], vehicle("nanobench")).blocking
        if f.check == "clock"
    ]
    assert "twice" in two.message
    assert two.evidence["repeated_rows"] == 1
    assert two.evidence["first_row"] == raw.rows[700]


def test_gaps_are_counted_and_a_large_one_blocks():
    raw = real(*STAR)
    small = check([without_rows(raw, 1000, 1050)], vehicle("nanobench")).of("gaps")
    assert any(
        f.severity == "warning" and f.evidence["longest_s"] == pytest.approx(0.51, abs=0.002)
        for f in small
    )
    assert blocking(without_rows(raw, 1000, 2500), "nanobench", "gaps")


def test_short_freeze_is_a_warning_with_its_place():
    raw = real(*STAR)
    (finding,) = check([frozen(raw, "p q r", 1000, 1030)], vehicle("nanobench")).of("frozen")
    assert finding.severity == "warning"
    assert finding.evidence["frozen_rows"] == 30
    assert finding.evidence["start_s"] == pytest.approx(raw.t[1000])


@pytest.mark.parametrize("columns", ["p", "az", "u1 u2 u3 u4"])
def test_one_axis_or_the_commands_that_stand_are_a_warning(columns):
    raw = frozen(real(*CIRCLE), columns, 800, 1400)
    (finding,) = check([raw], vehicle(CIRCLE[0])).of("frozen")
    assert finding.severity == "warning"
    assert finding.where.startswith(", ".join(columns.split()))
    assert finding.evidence["frozen_rows"] == pytest.approx(600, abs=2)


@pytest.mark.parametrize("step", [np.pi / 180, np.pi / 60])
def test_coarse_axes_of_slow_flight_are_not_frozen(step):
    raw = real(*STAR)
    coarse = {n: np.round(raw.channels[n] / step) * step for n in ("p", "q", "r")}
    assert not check([with_channels(raw, **coarse)], vehicle("nanobench")).of("frozen")


def test_commands_that_are_held_for_as_long_again_and_again_are_not_frozen():
    raw = real(*STAR)
    names, hold = ("u1", "u2", "u3", "u4"), np.random.default_rng(0).integers(20, 50, len(raw.t))
    first = np.repeat(np.cumsum(hold) - hold, hold)[: len(raw.t)]
    held = {n: raw.channels[n][np.minimum(first, len(raw.t) - 1)] for n in names}
    assert not check([with_channels(raw, **held)], vehicle("nanobench")).of("frozen")


def test_motors_at_their_limits_are_not_frozen():
    raw = real(*STAR)
    held = {n: raw.channels[n].copy() for n in ("u1", "u2", "u3", "u4")}
    for u in held.values():
        u[1000:1300] = u.max()
    assert not check([with_channels(raw, **held)], vehicle("nanobench")).of("frozen")


def test_saturated_commands_and_clipped_gyro():
    raw = real(*IMU)
    clipped = with_channels(raw, p=np.clip(raw.channels["p"], -5.0, 5.0))
    found = check([clipped], vehicle(IMU[0])).of("saturation")
    assert any("the sensor clips" in f.message and f.evidence["limit"] == 5.0 for f in found)
    full = with_channels(raw, u1=np.minimum(raw.channels["u1"] * 1.5, 1.0))
    shares = [
        f.evidence["share_u1"]
        for f in check([full], vehicle(IMU[0])).of("saturation")
        if "share_u1" in f.evidence
    ]
    assert max(shares) > 0.1


def test_a_floor_of_the_commands_above_u_min_is_told():
    """The idle of a firmware: armed rotors get no less, while the vehicle file says 0."""
    raw = real(*IMU)
    names = ("u1", "u2", "u3", "u4")
    u = np.column_stack([raw.channels[n] for n in names])
    idle = float(np.nanquantile(u, 0.05))
    assert idle > 0.05
    floor = dict(zip(names, np.maximum(u, idle).T, strict=True))
    said = check([with_channels(raw, **floor)], vehicle(IMU[0])).of("saturation")
    assert any(f"same least value {idle:.4g}" in f.message for f in said)
    for other in (raw, with_channels(raw, **dict(zip(names, np.round(u, 2).T, strict=True)))):
        said = check([other], vehicle(IMU[0])).of("saturation")
        assert not any("least value" in f.message for f in said)


def test_a_peak_in_the_largest_of_few_steps_is_no_clipping():
    """A quiet axis of a coarse sensor, sampled often: it stays in the largest step for a while."""
    raw = real(*IMU)
    slow = np.sin(3.0 * raw.t) + 0.7 * np.sin(4.7 * raw.t)
    for steps in (4.4, 9.9, 19.2):
        coarse = with_channels(raw, ax=np.rint(steps * slow / slow.max()) / steps)
        top = coarse.channels["ax"] == coarse.channels["ax"].max()
        assert top.sum() >= 5
        found = check([coarse], vehicle(IMU[0])).of("saturation")
        assert not any("clips" in f.message for f in found), steps


def test_a_still_axis_is_named():
    raw = real(*IMU)
    still = with_channels(raw, r=raw.channels["r"] * 0.01)
    (finding,) = check([still], vehicle(IMU[0])).of("excitation")
    assert finding.severity == "warning"
    assert "of r" in finding.message


def test_a_log_of_a_craft_on_the_bench_says_what_it_cannot_judge():
    raw = real(*STAR)
    bench = with_channels(raw, **{f"u{i}": np.zeros(raw.n) for i in range(1, 5)})
    report = check([bench], vehicle("nanobench"))
    assert any(u.check == "motors" for u in report.not_judged)


def test_a_dataset_can_be_checked_and_names_must_differ():
    v = vehicle("nanobench")
    flight = read_log(flight_path(*STAR), v)
    report = check(Dataset(flights=(flight,)), v)
    assert report.ok
    assert report.flights[0].rows == flight.n
    with pytest.raises(DataError, match="twice"):
        check([real(*STAR), real(*STAR)], v)


def test_checks_have_distinct_names_and_questions():
    assert len({c.name for c in CHECKS}) == len(CHECKS) == 14
    assert all(c.question.endswith("?") for c in CHECKS)


def test_checking_twice_gives_the_same_report_and_changes_nothing():
    raw = real(*STAR)
    before = {k: v.copy() for k, v in raw.channels.items()}
    assert (
        check([raw], vehicle("nanobench")).to_dict() == check([raw], vehicle("nanobench")).to_dict()
    )
    assert all(np.array_equal(before[k], v, equal_nan=True) for k, v in raw.channels.items())


@pytest.mark.parametrize("fields", [("gyrx", "gyrY", "gyrZ"), ("gyrx", "gyry", "gyrz")])
@pytest.mark.parametrize("conditioned", [False, True])
def test_a_column_that_is_mistyped_in_the_mapping_names_the_one_that_was_meant(
    fields, conditioned, tmp_path
):
    raw, path = real(*CIRCLE), tmp_path / "flight.csv"
    table = {"t": raw.t, **{n: raw.channels[n] for n in ("u1", "u2", "u3", "u4")}}
    table |= {f"gyr{a.upper()}": raw.channels[n] for a, n in zip("xyz", "pqr", strict=True)}
    np.savetxt(
        path, np.column_stack([*table.values()]), delimiter=",", header=",".join(table), comments=""
    )
    columns = vehicle_columns({"rate": {"fields": list(fields)}})
    craft = replace(vehicle(CIRCLE[0]), columns=columns)
    log = read_log(path, craft) if conditioned else read_table(path, craft)
    gaps = check(log if conditioned else [log], craft).of("gaps")
    (found,) = [f for f in gaps if f.where.startswith("channel p")]
    meant = ", ".join(f"gyr{f[3].upper()}" for f in fields if f[3].islower())
    assert f"; did you mean {meant}?" in found.message
    assert "[columns.rate]" in found.fix
    assert any(f"; did you mean {meant}?" in n for n in log.notes)


def vehicle_columns(content):
    said = mapping_of(content, where="test", path="columns")
    return replace(said, optional=frozenset(content))


def test_the_range_that_is_said_is_the_one_without_slack_for_noise():
    raw = real(*CIRCLE)
    fast = with_channels(raw, omega1=np.full(raw.n, 9000.0), u1=raw.channels["u1"] + 2.0)
    craft = replace(
        vehicle(CIRCLE[0]), actuator=replace(vehicle(CIRCLE[0]).actuator, speed_max=2000.0)
    )
    said = [f.message for f in check([fast], craft).of("ranges")]
    assert any("outside 0 .. 2600 rad/s" in m for m in said)
    assert any(m.endswith("outside 0 .. 1") for m in said)
