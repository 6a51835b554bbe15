"""Samples that no craft can have made become missing, are counted and listed; real motion, however
fast, is not touched."""

from __future__ import annotations

from dataclasses import replace

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

from greybox.automatic.fit import prepare
from greybox.data import read_logs
from greybox.data.checks import check
from greybox.data.impossible import MARGIN, OVERSPEED, RISE, without_impossible
from greybox.linear.logs import parse_channels, read_records
from tests.automatic.craft import flown, raw, vehicle, with_channel
from tests.data import faults

TOP = 2500.0
"""speed_max of the vehicle file."""


@pytest.fixture(scope="module")
def log():
    return raw(flown()[0])


def test_a_sound_log_is_handed_on_as_it_is(log):
    same = without_impossible(log, vehicle())
    assert same is log
    assert same.removed == ()


@pytest.mark.parametrize(
    ("spike", "why"), [(33_000.0, "outside its range"), (4000.0, f"{OVERSPEED * TOP:.4g} rad/s")]
)
def test_rotor_speeds_far_beyond_the_top_speed_are_missing_and_counted(log, spike, why):
    assert vehicle().actuator.speed_max == TOP
    at = [100, 101, 300, 420, 700]
    speeds = log.channels["omega2"].copy()
    speeds[at] = spike
    clean = without_impossible(with_channel(log, omega2=speeds), vehicle())
    (removed,) = clean.removed
    assert np.flatnonzero(np.isnan(clean.channels["omega2"])).tolist() == at
    assert (removed.count, removed.worst, removed.channels) == (5, spike, ("omega2",))
    assert removed.first_time == log.t[100]
    assert "5 sample(s) of omega2" in clean.notes[-1]
    assert why in removed.line()
    for name in log.channels:
        if name != "omega2":
            assert clean.channels[name] is log.channels[name]


def test_a_rotor_at_rest_may_read_a_little_below_zero(log):
    """Noise of either sign: neither a fault nor an impossible sample. Speeds that carry the sense
    of rotation as a sign are one."""
    rng = np.random.default_rng(0)
    at_rest = np.abs(log.channels["omega1"])
    at_rest[100:150] = 4.0 * rng.standard_normal(50)
    assert (at_rest < 0).sum() > 10
    still = with_channel(log, omega1=at_rest)
    assert without_impossible(still, vehicle()).removed == ()
    assert not [f for f in check([still], vehicle()).of("ranges") if f.severity != "info"]
    signed = with_channel(log, omega1=-np.abs(log.channels["omega1"]))
    assert any(f.severity == "blocking" for f in check([signed], vehicle()).of("ranges"))


def test_a_rotor_a_little_beyond_its_top_speed_stays(log):
    speeds = np.full(log.n, 1.25 * TOP)
    assert without_impossible(with_channel(log, omega1=speeds), vehicle()).removed == ()


@pytest.mark.parametrize(
    ("name", "jump", "group"),
    [("x", 0.3, ("x", "y", "z")), ("qy", 0.4, ("qw", "qx", "qy", "qz"))],
)
def test_a_jump_that_no_motion_explains_takes_its_whole_sample(log, name, jump, group):
    values = log.channels[name].copy()
    values[250] += jump
    clean = without_impossible(with_channel(log, **{name: values}), vehicle())
    (removed,) = clean.removed
    assert removed.channels == group
    assert (removed.count, removed.first_time) == (1, log.t[250])
    for n in group:
        assert np.flatnonzero(np.isnan(clean.channels[n])).tolist() == [250]


STAR, IMU = ("nanobench", "B8_star_fast_rep2"), ("arpl_crazyflie", "log15")


@pytest.mark.parametrize(
    ("flight", "name", "size"),
    [
        (STAR, "p", 4.0),
        (STAR, "r", 4.0),
        (STAR, "ax", 15.0),
        (STAR, "az", 15.0),
        (STAR, "x", 0.05),
        (STAR, "vz", 0.2),
        (STAR, "qy", 0.16),
        (STAR, "vbat", 0.9),
        (IMU, "q", 0.7),
        (IMU, "ay", 6.0),
    ],
)
def test_lone_samples_of_every_sensor_of_real_flights_are_taken_and_no_others(flight, name, size):
    """100 Hz, interpolated, and 1 kHz as it was sampled; some of them two or three rows apart."""
    real, craft = faults.real(*flight), faults.vehicle(flight[0])
    rng = np.random.default_rng(5)
    at = np.sort(rng.choice(np.arange(500, real.n - 900, 40), 20, replace=False))
    at = np.concatenate([at, at[:5] + 2, at[5:10] + 3])
    values = real.channels[name].copy()
    values[at] += size * rng.choice([-1.0, 1.0], at.size)
    sound = without_impossible(real, craft).channels[name]
    taken = without_impossible(faults.with_channels(real, **{name: values}), craft).channels[name]
    assert np.flatnonzero(np.isnan(taken) & ~np.isnan(sound)).tolist() == sorted(at)


def test_spikes_of_two_axes_in_rows_that_follow_each_other_do_not_hide_one_another(log):
    rates = {n: log.channels[n].copy() for n in "pqr"}
    rates["p"][[250, 400]] += 60.0
    rates["q"][251] -= 60.0
    (removed,) = without_impossible(with_channel(log, **rates), vehicle()).removed
    assert (removed.channels, removed.count) == (("p", "q", "r"), 3)


def test_a_step_that_stays_is_no_single_sample(log):
    values = log.channels["x"].copy()
    values[250:] += 0.3
    assert without_impossible(with_channel(log, x=values), vehicle()).removed == ()


def test_an_attitude_written_with_the_other_sign_is_the_same_attitude(log):
    names = ("qw", "qx", "qy", "qz")
    other = {n: log.channels[n].copy() for n in names}
    for values in other.values():
        values[[100, 250, 251, 400]] *= -1.0
    assert without_impossible(with_channel(log, **other), vehicle()).removed == ()
    other["qy"][400] += 0.4
    (removed,) = without_impossible(with_channel(log, **other), vehicle()).removed
    assert (removed.channels, removed.count, removed.first_time) == (names, 1, log.t[400])


def slow_pose(log):
    """The log with a pose in every fifth row only, 20 Hz among 100 Hz."""
    between = np.arange(log.n) % 5 != 0
    pose = ("x", "y", "z", "qw", "qx", "qy", "qz")
    return with_channel(log, **{n: np.where(between, np.nan, log.channels[n]) for n in pose})


def test_a_slow_pose_among_fast_rows_is_judged_against_its_own_neighbours(log):
    slow = slow_pose(log)
    assert without_impossible(slow, vehicle()).removed == ()
    place = slow.channels["x"].copy()
    place[250] += 50.0
    (removed,) = without_impossible(with_channel(slow, x=place), vehicle()).removed
    assert (removed.channels, removed.count, removed.first_time) == (("x", "y", "z"), 1, log.t[250])


def test_a_row_with_the_stamp_of_the_one_before_hides_no_spike(log):
    t, x = log.t.copy(), log.channels["x"].copy()
    t[251] = t[250]
    x[250] += 50.0
    x[251] = np.nan
    (removed,) = without_impossible(replace(with_channel(log, x=x), t=t), vehicle()).removed
    assert (removed.count, removed.first_time) == (1, log.t[250])


def test_what_the_rotors_can_do_is_taken_at_full_command(log):
    """The same craft with commands in percent: what is possible is what it was."""
    own = vehicle()
    c0, c1, c2 = own.actuator.thrust
    scaled = (c0, replace(c1, value=c1.value / 100), replace(c2, value=c2.value / 1e4))
    percent = replace(own, actuator=replace(own.actuator, u_max=100.0, thrust=scaled))
    push = MARGIN * 4 * sum(c.value for c in own.actuator.thrust) / own.mass.value
    # Thrust that rises for half a step of 10 ms and falls for the other, there and back.
    gained = push * 0.01 * (0.01 / (4 * RISE))
    still = with_channel(log, **{n: np.zeros(log.n) for n in ("vx", "vy", "vz")})
    for craft in (own, percent):
        for share, count in ((0.95, 0), (1.05, 1)):
            moved = np.zeros(log.n)
            moved[250] = share * gained
            assert len(without_impossible(with_channel(still, vx=moved), craft).removed) == count


def test_a_gyro_in_coarse_steps_that_flickers_between_two_of_them_is_sound(log):
    """Betaflight logs whole degrees per second: in a calm stretch nothing moves but one step."""
    step, n = np.deg2rad(1.0), 4000
    rng = np.random.default_rng(0)
    t = 5e-4 * np.arange(n)
    smooth = 2.0 * np.sin(2 * np.pi * t) * (t > 1.0)
    rates = {k: step * np.rint((smooth + 0.2 * step * rng.normal(size=n)) / step) for k in "pqr"}
    rows = {k: np.zeros(n) for k in log.channels if k not in "pqr"} | rates
    calm = replace(log, t=t, rows=np.arange(1, n + 1), channels=rows)
    calm = replace(calm, channels={k: calm.channels[k] for k in "pqr"})
    assert np.median(np.abs(np.diff(rates["p"], 2))) == 0.0 < np.ptp(rates["p"][:2000])
    assert without_impossible(calm, vehicle()).removed == ()
    struck = rates["p"].copy()
    struck[700] += 90 * step
    (removed,) = without_impossible(with_channel(calm, p=struck), vehicle()).removed
    assert (removed.count, removed.first_time) == (1, t[700])


@pytest.mark.parametrize("low", [-1.0, 0.0])
def test_spikes_that_repeat_two_values_are_no_steps_of_a_sensor(log, low):
    """Full scale of both signs, or full scale and nothing, as a bus has them."""
    n, rng = 2000, np.random.default_rng(0)
    t = 0.005 * np.arange(n)
    rates = {k: np.sin(2.0 * t + i) + 0.02 * rng.normal(size=n) for i, k in enumerate("pqr")}
    rates["p"][[300, 700, 1100, 1500]] = 34.9065850 * np.array([1.0, low, 1.0, low])
    struck = replace(log, t=t, rows=np.arange(1, n + 1), channels=rates)
    (removed,) = without_impossible(struck, vehicle()).removed
    assert removed.count == (4 if low else 2)


def test_what_was_taken_is_among_the_decisions_and_can_be_kept(log):
    speeds = log.channels["omega2"].copy()
    speeds[100] = 33_000.0
    bad = with_channel(log, omega2=speeds)
    (said,) = [d for d in prepare(vehicle(), [bad]).decisions() if d.about == "impossible samples"]
    assert "1 of omega2 missing in run0" in said.choice
    assert said.option == "--keep-impossible"
    assert prepare(vehicle(), [bad], keep_impossible=True).removed == ()


def test_whoever_reads_a_log_with_its_vehicle_reads_it_without_them(log, tmp_path):
    """One door: `read_logs`, the records of linear models, and what the commands read."""
    speeds = log.channels["omega2"].copy()
    speeds[[100, 300]] = 33_000.0
    table = {"t": log.t, **log.channels, "omega2": speeds}
    path = tmp_path / "spiked.csv"
    np.savetxt(
        path,
        np.column_stack(list(table.values())),
        delimiter=",",
        header=",".join(table),
        comments="",
    )
    data = read_logs([path], vehicle())
    (removed,) = data.removed
    assert (removed.flight, removed.count) == ("spiked", 2)
    assert np.nanmax(data.flights[0].segments[0].column("omega2")) < TOP
    assert any(removed.line() in note for note in data.flights[0].notes)
    assert read_logs([path], vehicle(), keep_impossible=True).removed == ()
    assert read_logs([path], None).removed == ()
    linear = read_records(
        [path], parse_channels("u1", "inputs"), parse_channels("omega2", "outputs"), vehicle()
    )
    assert any(removed.line() in note for note in linear.notes)
    # What was taken is known to a fit that is handed the data set, and is not taken twice.
    prepared = prepare(vehicle(), data, decide_rate=False)
    assert prepared.data.hash == data.hash
    assert prepared.removed == (removed,)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    frequency=st.floats(0.2, 8.0),
    size=st.floats(0.0, 1.0),
    phase=st.floats(0.0, 6.3),
    rate=st.sampled_from([50.0, 100.0, 500.0]),
    noise=st.floats(0.0, 0.01),
    seed=st.integers(0, 99),
)
def test_smooth_motion_that_the_rotors_can_make_is_never_touched(
    frequency, size, phase, rate, noise, seed
):
    """A turn about x to and fro at up to full torque, a way to and fro at up to full thrust, with
    sensor noise."""
    own, draw = vehicle(), np.random.default_rng(seed)
    t = np.arange(0.0, 4.0, 1.0 / rate)
    w = 2 * np.pi * frequency
    thrust = 4 * own.actuator.thrust[2].value
    turn = (
        size * 0.0325 * thrust / own.inertia[0][0] / w**2
    )  # amplitude [rad] whose acceleration the rotors can make
    way = size * thrust / own.mass.value / w**2
    angle = min(turn, 3.0) * np.sin(w * t + phase)
    rolling = min(turn, 3.0) * w * np.cos(w * t + phase)
    zero = np.zeros_like(t)

    def shaken(values: np.ndarray, level: float) -> np.ndarray:
        return values + noise * level * draw.normal(size=t.size)

    attitude = np.array(
        [shaken(part, 1.0) for part in (np.cos(angle / 2), np.sin(angle / 2), zero, zero)]
    )
    attitude /= np.linalg.norm(attitude, axis=0)
    columns = {
        "t": t,
        "u1": zero + 0.5,
        "u2": zero + 0.5,
        "u3": zero + 0.5,
        "u4": zero + 0.5,
        **dict(zip(("qw", "qx", "qy", "qz"), attitude, strict=True)),
        "p": shaken(rolling, 10.0),
        "q": shaken(zero, 10.0),
        "r": shaken(zero, 10.0),
        "x": shaken(way * np.sin(w * t + phase), 1.0),
        "y": shaken(zero, 1.0),
        "z": shaken(zero, 1.0),
        "vx": shaken(way * w * np.cos(w * t + phase), 10.0),
        "vy": shaken(zero, 10.0),
        "vz": shaken(zero, 10.0),
    }
    assert without_impossible(raw(columns), own).removed == ()
