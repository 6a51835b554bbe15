"""Conditioning keeps every measured value, leaves missing ones missing, and says what it did."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from greybox.data import Dataset, RawLog, dataset_from_arrays, read_log, read_table
from greybox.data.conditioning import condition
from greybox.errors import DataError
from greybox.examples import flight_path, flight_paths, vehicle_path
from greybox.model.vehicle import read_vehicle

# First and last time [s] above 0.3 m, as the authors' positions give them.
ABOVE = {
    "B2_circle_fast_rep1": (3.71, 23.25),
    "B2_circle_medium_rep1": (3.68, 23.24),
    "B2_circle_slow_rep1": (3.64, 23.01),
    "B3_figure8_fast_rep1": (3.69, 22.70),
    "B3_figure8_medium_rep2": (3.62, 37.97),
    "B3_figure8_slow_rep1": (3.64, 22.68),
    "B5_helix_fast_mell_rep1": (3.29, 37.61),
    "B5_helix_medium_rep2": (4.33, 38.09),
    "B7_oval_fast_rep1": (3.67, 38.02),
    "B7_oval_medium_rep2": (3.76, 38.04),
    "B8_star_fast_rep2": (2.97, 37.35),
    "B8_star_fast_rep3": (3.04, 37.38),
    "B8_star_medium_rep1": (3.70, 38.00),
    "B8_star_slow_rep2": (2.93, 37.41),
}


def raw_log(t, **channels):
    t = np.asarray(t, dtype=float)
    return RawLog(
        t=t,
        channels={k: np.asarray(v, dtype=float) for k, v in channels.items()},
        extra={},
        rows=np.arange(2, t.size + 2),
        flight="made",
        source="made.csv",
        sha256="",
    )


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(p, id=p.name.split(".")[0], marks=() if i % 3 == 0 else pytest.mark.slow)
        for i, p in enumerate(flight_paths("nanobench"))
    ],
)
def test_the_cut_keeps_the_airborne_stretch(path):
    flight = read_log(path, read_vehicle(vehicle_path("nanobench")))
    first, last = ABOVE[flight.name]
    assert len(flight.segments) == 1
    assert flight.segments[0].t[0] == pytest.approx(first, abs=0.08)
    assert flight.segments[0].t[-1] == pytest.approx(last, abs=0.03)
    assert flight.dt == 0.01
    assert any("on the ground" in n for n in flight.notes)


def test_untrimmed_uniform_logs_keep_every_value():
    vehicle = read_vehicle(vehicle_path("nanobench"))
    path = flight_path("nanobench", "B7_oval_fast_rep1")
    flight = read_log(path, vehicle, trim=False)
    (segment,) = flight.segments
    from greybox.data import read_table

    raw = read_table(path, vehicle)
    seen = np.isfinite(segment.column("p"))
    assert np.array_equal(segment.column("p")[seen], raw.channels["p"])
    assert segment.n - seen.sum() == 11  # dropped ticks of the motion capture clock
    assert np.isfinite(segment.column("u1")).all()
    assert any("commands interpolated over 11 lost row(s)" in n for n in flight.notes)
    assert np.abs(segment.t[seen] - raw.t).max() < 5e-4


@given(
    n=st.integers(60, 300),
    rate=st.sampled_from([50.0, 100.0, 250.0, 400.0, 1000.0]),
    dropped=st.sets(st.integers(1, 58), max_size=12),
    start=st.floats(0.0, 1e5),
)
def test_dropped_samples_stay_missing(n, rate, dropped, start):
    keep = np.array([k not in dropped for k in range(n)])
    steps = np.flatnonzero(keep)
    if np.diff(steps).max() / rate > 0.09:
        return
    values = np.sin(np.arange(n))
    t = start + np.arange(n) / rate
    flight = condition(raw_log(t[keep], u1=values[keep] + 2.0, p=values[keep]), trim=False)
    (segment,) = flight.segments
    assert segment.n == n
    assert segment.dt == pytest.approx(1 / rate, rel=1e-9)
    assert np.array_equal(np.isnan(segment.column("p")), ~keep)
    assert np.array_equal(segment.column("p")[keep], values[keep])
    between = np.interp(np.arange(n), steps, values[keep]) + 2.0
    assert segment.column("u1") == pytest.approx(between, rel=1e-12)
    assert np.array_equal(segment.column("u1")[keep], values[keep] + 2.0)


def test_gaps_end_segments_and_max_gap_decides():
    t = np.concatenate([np.arange(100), np.arange(130, 260)]) * 0.01
    raw = raw_log(t, u1=np.full(t.size, 0.5), p=np.sin(t))
    assert [s.n for s in condition(raw, trim=False).segments] == [100, 130]
    for most in (0.5, np.inf):
        (whole,) = condition(raw, trim=False, max_gap=most).segments
        assert whole.n == 260
        assert int(np.isnan(whole.column("p")).sum()) == 30


@settings(max_examples=25)
@given(seed=st.integers(0, 10_000))
def test_resampling_an_irregular_clock_reproduces_slow_signals(seed):
    rng = np.random.default_rng(seed)
    steps = rng.uniform(0.8e-3, 1.2e-3, 3000)
    t = np.cumsum(steps * 1e-3 / steps[1:].mean())
    u = np.repeat(rng.uniform(0.2, 0.8, 30), 100)
    flight = condition(raw_log(t, u1=u, p=np.sin(20 * t)), trim=False)
    (segment,) = flight.segments
    assert segment.dt == 1e-3
    assert np.abs(segment.column("p") - np.sin(20 * segment.t)).max() < 1e-3
    # A command acts from its stamp on: every step of the grid gets what acted over it in the mean.
    acted = np.concatenate([[0.0], np.cumsum(u[:-1] * np.diff(t))])
    edges = np.append(segment.t, segment.t[-1] + segment.dt)
    mean = np.diff(np.interp(edges, t, acted)) / segment.dt
    assert np.abs(segment.column("u1") - mean)[:-1].max() < 1e-9
    assert u.min() <= segment.column("u1").min() <= segment.column("u1").max() <= u.max()
    assert any("not uniform" in n and "resampled to 1000 Hz" in n for n in flight.notes)


def test_noisy_stamps_cost_a_command_no_sample():
    """Stamps that are a tenth of a sample off move a command by as much, not by a sample."""
    rng = np.random.default_rng(5)
    ideal = 0.01 * np.arange(2000)
    t = ideal + rng.normal(0.0, 1e-3, ideal.size)
    u = rng.uniform(0.3, 0.7, ideal.size)
    (segment,) = condition(raw_log(t, u1=u, p=np.sin(t)), trim=False).segments
    assert segment.dt == pytest.approx(0.01, rel=1e-3)
    sent = u[np.clip(np.round((segment.t - ideal[0]) / 0.01).astype(int), 0, u.size - 1)]
    off = segment.column("u1") - sent
    assert np.sqrt(np.mean(off**2)) < 0.25 * np.sqrt(np.mean(np.diff(u) ** 2))


def test_downsampling_averages_and_keeps_the_integral_of_the_command():
    t = np.arange(4000) * 1e-3
    rng = np.random.default_rng(1)
    u = np.repeat(rng.uniform(0.2, 0.8, 400), 10)
    (segment,) = condition(raw_log(t, u1=u, p=np.sin(3 * t)), rate=50.0, trim=False).segments
    assert segment.dt == 0.02
    inner = slice(1, -2)
    assert segment.column("u1")[inner] == pytest.approx(
        u.reshape(-1, 20).mean(axis=1)[: segment.n][inner], abs=1e-9
    )
    assert segment.column("p")[inner] == pytest.approx(np.sin(3 * segment.t)[inner], abs=3e-4)


def test_nothing_is_interpolated_across_a_hole_in_the_cells():
    t = np.cumsum(np.random.default_rng(0).uniform(0.8e-3, 1.2e-3, 2000))
    p = np.sin(t)
    p[500:600] = np.nan
    (segment,) = condition(raw_log(t, u1=np.full(2000, 0.5), p=p), trim=False).segments
    hole = (segment.t > t[499]) & (segment.t < t[600])
    assert np.isnan(segment.column("p")[hole]).all()
    assert np.isfinite(segment.column("p")[~hole]).all()


@settings(max_examples=60)
@given(st.integers(1, 8), st.integers(0, 7), st.sampled_from([50.0, 100.0, 133.0, 200.0, 400.0]))
def test_a_slow_channel_keeps_its_samples_at_any_rate(every, phase, rate):
    """Motion capture on every second row of a log must not vanish, nor move in time."""
    t = np.arange(0, 4, 1 / 400.0)
    x = np.full(t.size, np.nan)
    x[phase::every] = 3.0 - 2.0 * t[phase::every]
    flight = condition(raw_log(t, u1=np.full(t.size, 0.5), x=x), rate=rate, trim=False)
    (segment,) = flight.segments
    known = np.isfinite(segment.column("x"))
    assert known.sum() >= 0.97 * min(segment.n, np.isfinite(x).sum()) - 2
    assert segment.column("x")[known] == pytest.approx(3.0 - 2.0 * segment.t[known], abs=1e-6)


def jittered(seed: int, n: int = 1500, jitter: float = 0.05) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.cumsum(0.01 * (1 + jitter * rng.uniform(-1, 1, n)))


@pytest.mark.parametrize("seed", range(6))
def test_a_channel_of_half_the_rate_is_never_filled_up(seed):
    """Each of its samples counts once, however the clock jitters."""
    t = jittered(seed)
    x = np.where(np.arange(t.size) % 2 == 0, t, np.nan)
    flight = condition(raw_log(t, u1=np.full(t.size, 0.5), x=x), trim=False)
    known = np.isfinite(flight.segments[0].column("x"))
    assert known.mean() == pytest.approx(0.5, abs=0.01)


def test_a_slow_command_is_held_until_its_next():
    t = jittered(1, jitter=0.2)
    u = np.where(np.arange(t.size) % 30 == 0, 0.5, np.nan)
    flight = condition(raw_log(t, u1=u, p=t), trim=False)
    assert len(flight.segments) == 1
    assert flight.segments[0].n > 0.99 * t.size


def test_a_lost_row_without_a_command_leaves_the_last_one_standing():
    k = np.arange(200)
    u = np.where(k % 2 == 0, np.sin(0.1 * k), np.nan)
    kept = k != 51
    (segment,) = condition(raw_log(k[kept] * 0.01, u1=u[kept], p=k[kept]), trim=False).segments
    assert segment.column("u1") == pytest.approx(np.sin(0.1 * (k - k % 2)))


def test_a_lost_command_of_a_slow_stream_lies_between_its_neighbours_from_where_it_was_due():
    k = np.arange(200)
    sent = np.where(k % 3 == 0, np.sin(0.1 * k), np.nan)
    kept = k != 60
    (segment,) = condition(raw_log(k[kept] * 0.01, u1=sent[kept], p=k[kept]), trim=False).segments
    expected = np.sin(0.1 * (k - k % 3))
    expected[60:63] = 0.5 * (np.sin(5.7) + np.sin(6.3))
    assert segment.column("u1") == pytest.approx(expected)


def test_a_command_of_a_kept_row_that_has_none_is_held():
    k = np.arange(200)
    u = np.where(k == 50, np.nan, np.sin(0.1 * k))
    (segment,) = condition(raw_log(k * 0.01, u1=u, p=k), trim=False).segments
    assert segment.column("u1")[50] == np.sin(4.9)


def test_a_command_from_before_a_gap_is_in_no_mean():
    t = np.arange(0, 3, 0.005)
    u = np.where(t < 1.0, 0.2, np.where(t < 1.505, np.nan, 0.8))
    flight = condition(raw_log(t, u1=u, p=t), rate=100, trim=False)
    found = np.concatenate([s.column("u1") for s in flight.segments])
    assert found == pytest.approx(np.where(found < 0.5, 0.2, 0.8))


def test_a_hole_in_averaged_rows_loses_none_and_moves_none():
    t = np.arange(0, 10, 0.002)
    x = np.sin(2 * t)
    x[(np.arange(t.size) + 1) % 25 < 3] = np.nan
    flight = condition(raw_log(t, u1=np.full(t.size, 0.5), x=x), rate=20, trim=False)
    (segment,) = flight.segments
    # Nothing is known at the first row.
    assert np.abs(segment.column("x") - np.sin(2 * segment.t))[1:].max() < 2e-3


def test_an_attitude_that_misses_one_number_keeps_its_sign():
    t = jittered(2)
    half = 0.3 * t
    sign = np.where(t > 7, -1.0, 1.0)
    q = sign * np.array([np.cos(half), 0 * t, 0 * t, np.sin(half)])
    q[0, 1000::7] = np.nan
    names = ("qw", "qx", "qy", "qz")
    flight = condition(raw_log(t, u1=np.full(t.size, 0.5), **dict(zip(names, q))), trim=False)
    (segment,) = flight.segments
    found = segment.matrix(names)
    known = np.isfinite(found).all(axis=1)
    turned = 2 * np.arctan2(found[known, 3], found[known, 0])
    away = np.angle(np.exp(1j * (turned - 0.6 * segment.t[known])))
    assert known.mean() > 0.99
    assert np.abs(away).max() < 1e-3


def test_quaternion_signs_do_not_spoil_resampling():
    t = np.cumsum(np.random.default_rng(0).uniform(8e-3, 12e-3, 500))
    sign = np.where(np.arange(500) % 2, 1.0, -1.0)
    q = {"qw": np.cos(t / 2) * sign, "qx": np.sin(t / 2) * sign, "qy": 0 * t, "qz": 0 * t}
    (segment,) = condition(raw_log(t, u1=np.full(500, 0.5), **q), trim=False).segments
    size = segment.matrix(["qw", "qx", "qy", "qz"])
    assert np.linalg.norm(size, axis=1) == pytest.approx(1.0)
    assert np.abs(segment.column("qw")) == pytest.approx(np.abs(np.cos(segment.t / 2)), abs=1e-4)


def test_lost_attitude_becomes_missing_and_is_reported():
    t = np.arange(200) * 0.01
    zero = np.zeros(200)
    qw = np.where((t > 0.5) & (t < 0.7), 0.0, 1.0)
    flight = condition(raw_log(t, u1=zero + 0.5, qw=qw, qx=zero, qy=zero, qz=zero), trim=False)
    assert np.isnan(flight.segments[0].column("qw")).sum() == (qw == 0).sum()
    assert any("unit length" in n for n in flight.notes)


def test_a_log_that_begins_and_ends_in_flight_is_left_whole():
    t = np.arange(1000) * 0.01
    u = 0.6 + 0.05 * np.sin(7 * t)
    flight = condition(raw_log(t, u1=u, u2=u, z=0.01 * np.sin(t), p=np.sin(t)))
    assert flight.n == 1000
    assert any("nothing cut" in n for n in flight.notes)


def test_a_landing_inside_an_imu_log_breaks_it():
    flight = read_log(
        flight_path("arpl_crazyflie", "log16"), read_vehicle(vehicle_path("arpl_crazyflie"))
    )
    assert len(flight.segments) == 2
    assert flight.segments[1].t[0] - flight.segments[0].t[-1] > 5.0


def test_time_that_goes_back_names_the_row():
    t = np.arange(100) * 0.01
    t[40] = t[39]
    with pytest.raises(DataError, match=r"row 42: the same time stamp twice"):
        condition(raw_log(t, p=t))
    t[40] = t[10]
    with pytest.raises(DataError, match=r"row 42: time goes back"):
        condition(raw_log(t, p=t))


@pytest.mark.parametrize("rate", [0.0, -5.0, float("nan"), float("inf")])
def test_bad_rates(rate):
    with pytest.raises(DataError, match="rate"):
        condition(raw_log([0.0, 0.1, 0.2], p=[0, 0, 0]), rate=rate)


def test_inputs_are_not_changed():
    t = np.arange(100) * 0.01
    raw = raw_log(t, u1=np.full(100, 0.5), p=np.sin(t))
    before = raw.channels["p"].copy()
    condition(raw)
    condition(raw, rate=30.0)
    assert np.array_equal(raw.channels["p"], before)


def test_a_clock_in_the_wrong_unit_is_named_and_not_the_commands():
    vehicle = read_vehicle(vehicle_path("nanobench"))
    raw = read_table(flight_path("nanobench", "B2_circle_fast_rep1"), vehicle)
    with pytest.raises(DataError, match=r"1e\+08 Hz, as no flight log has.*\[columns.time\] unit"):
        condition(replace(raw, t=1e-6 * raw.t), vehicle, rate=100.0)


def merged(jitter: float = 0.0):
    """A gyro with commands at 250 Hz and a position at 100 Hz, as an outer merge of both has them:
    a row per stamp of either."""
    fast, slow = np.arange(0.0, 8.0, 0.004), np.arange(0.001, 7.99, 0.01)
    fast = fast + jitter * np.random.default_rng(0).uniform(-1.0, 1.0, fast.size)
    t = np.union1d(fast, slow)
    of_fast, of_slow = np.isin(t, fast), np.isin(t, slow)

    def on(rows, values):
        return np.where(rows, values, np.nan)

    channels = {n: on(of_fast, np.sin(t + k)) for k, n in enumerate("pqr")}
    channels |= {f"u{i}": on(of_fast, 0.6 + 0.1 * np.sin(3.0 * t + i)) for i in (1, 2, 3, 4)}
    channels |= {n: on(of_slow, np.cos(t + k)) for k, n in enumerate("xyz")}
    return raw_log(t, **channels), fast


@pytest.mark.parametrize("rate", [None, 250.0])
def test_rows_of_merged_streams_become_those_of_the_gyro(rate):
    raw, stamps = merged()
    (segment,) = condition(raw, trim=False, rate=rate).segments
    np.testing.assert_allclose(segment.t, stamps, atol=1e-9)
    np.testing.assert_array_equal(segment.column("p"), raw.channels["p"][np.isin(raw.t, stamps)])
    np.testing.assert_array_equal(segment.column("u2"), raw.channels["u2"][np.isin(raw.t, stamps)])
    there = np.isfinite(segment.column("x"))
    assert there.sum() >= 795
    np.testing.assert_allclose(segment.column("x")[there], np.cos(segment.t[there]), atol=2e-4)


def test_merged_streams_say_so_and_a_gyro_without_a_rhythm_is_resampled_as_before():
    (note,) = [n for n in condition(merged()[0], trim=False).notes if n.startswith("clock")]
    assert "rows of several streams" in note
    assert "250 Hz" in note
    (note,) = [n for n in condition(merged(0.0015)[0], trim=False).notes if n.startswith("clock")]
    assert "not uniform" in note


@pytest.mark.parametrize("begins", [0.0, 4e4, 1.7e9])
@pytest.mark.parametrize("rate", [None, 300.0, 123.0])
def test_a_log_has_one_sample_time_whatever_its_clock_counts_from(begins: float, rate):
    """A double holds the seconds since 1970 to 0.24 us: stretches of other lengths tell the sample
    time apart by 1e-10 s."""
    t = np.arange(600) * 0.01
    kept = (t < 1.0) | (t > 1.6)
    raw = raw_log(t[kept] + begins, p=np.sin(t[kept]), u1=np.full(kept.sum(), 0.5))
    flight = condition(raw, trim=False, rate=rate)
    assert len(flight.segments) == 2
    assert flight.dt == float(f"{1 / (rate or 100.0):.12g}")
    first, last = Dataset(flights=(flight,)).split_by_time(0.05)
    assert first.flights[0].dt == last.flights[0].dt == flight.dt
    plain = dataset_from_arrays(t + begins, {"p": np.sin(t)})
    assert {p.flights[0].dt for p in plain.split_by_time(0.03)} == {0.01}


def test_a_sample_time_that_the_stamps_contradict_is_not_believed():
    (segment,) = dataset_from_arrays(np.arange(9) * 0.01, {"p": np.zeros(9)}).segments
    assert replace(segment, t=2 * segment.t).dt == 0.02
    assert replace(segment, t=np.arange(9) / 300).dt == float(f"{1 / 300:.12g}")
