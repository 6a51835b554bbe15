"""Streams of different rates and clocks meet on one row clock without invented samples, delays or
lost gaps."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest

from greybox.cli import main
from greybox.data.inspection import inspect_log
from greybox.data.placing import at_rows, commands_at
from greybox.data.readers import Recording, Source, Stream, assemble, choose
from greybox.data.readers.mapping import LogMapping, read_mapping
from greybox.errors import DataError, UnknownNameError
from tests.data.readers import writers as w

ROWS = 0.01 * np.arange(200)


def wave(t: np.ndarray) -> np.ndarray:
    return np.sin(2.0 * t)[:, None]


def test_a_slow_stream_keeps_its_number_of_samples_and_its_times() -> None:
    t = 0.1037 * np.arange(18) + 0.0031
    out = at_rows(t, wave(t), ROWS, 0.01)
    known = np.isfinite(out[:, 0])
    assert known.sum() == t.size
    # Moved to the row's own time: without that the value would be wrong by up to 2.0 * 5 ms.
    np.testing.assert_allclose(out[known], wave(ROWS[known]), atol=1e-3)


def test_a_stream_of_about_the_rate_is_interpolated() -> None:
    t = 0.0113 * np.arange(180)
    out = at_rows(t, wave(t), ROWS, 0.01)
    inside = t[-1] >= ROWS
    np.testing.assert_allclose(out[inside], wave(ROWS[inside]), atol=1e-4)


def test_a_fast_stream_is_averaged_around_the_row() -> None:
    rng = np.random.default_rng(0)
    t = 0.001 * np.arange(2000)
    noise = rng.normal(size=(2000, 1))
    out = at_rows(t, wave(t) + noise, ROWS, 0.01)
    left = (out - wave(ROWS))[5:-5]
    assert left.std() < 0.45, "ten samples average to less than half the noise"
    assert abs(left.mean()) < 0.05


def test_nothing_is_carried_over_a_gap() -> None:
    t = np.concatenate([0.01 * np.arange(80), 0.01 * np.arange(120, 200)]) + 0.002
    out = at_rows(t, wave(t), ROWS, 0.01)
    assert np.isnan(out[82:118]).all()
    assert np.isfinite(out[1:79]).all()


def test_quaternions_are_not_averaged_through_a_change_of_sign() -> None:
    t = 0.01 * np.arange(200) + 0.005
    q = np.tile([1.0, 0.0, 0.0, 0.0], (200, 1))
    q[100:] *= -1.0
    out = at_rows(t, q, ROWS, 0.01)
    np.testing.assert_allclose(np.linalg.norm(out[1:], axis=1), 1.0)


def test_a_command_is_the_mean_of_what_was_held_until_the_next_row() -> None:
    t = np.array([0.0, 0.004, 0.010, 0.020])
    u = np.array([[0.0], [1.0], [0.5], [0.25]])
    rows = np.array([0.0, 0.01, 0.02])
    out = commands_at(t, u, rows, 0.01, 0.005)
    np.testing.assert_allclose(out[:, 0], [0.6, 0.5, 0.25])


def test_a_command_is_not_known_before_the_first_and_long_after_the_last() -> None:
    t = 0.5 + 0.01 * np.arange(30)
    out = commands_at(t, np.ones((30, 1)), ROWS, 0.01, 0.01)
    assert np.isnan(out[:49]).all()
    assert np.isfinite(out[51:80]).all()
    assert np.isnan(out[95:]).all(), "the last command is 0.15 s old there"


def recording(**streams: Stream) -> Recording:
    sources = (
        Source(group="rate", stream="slow", fields=("x", "y", "z")),
        Source(group="rate", stream="fast", fields=("x", "y", "z")),
        Source(group="rate", stream="fastest", fields=("x", "y", "z")),
    )
    return Recording(format="test", source="test.log", sha256="", streams=streams, sources=sources)


def stream(
    name: str, rate: float, seconds: float = 2.0, value: float = 1.0, start: float = 0.0
) -> Stream:
    t = start + np.arange(int(seconds * rate)) / rate
    return Stream(name=name, t=t, fields={k: np.full(t.size, value) for k in "xyz"})


def test_of_two_gyros_the_first_one_that_is_fast_enough_is_taken() -> None:
    full = recording(
        slow=stream("slow", 20), fast=stream("fast", 200), fastest=stream("fastest", 1000)
    )
    assert choose(full)["rate"].stream == "fast"
    assert choose(recording(slow=stream("slow", 20)))["rate"].stream == "slow"
    asked = LogMapping(preferred={"rate": "slow"}, where="map.toml")
    assert choose(full, asked)["rate"].stream == "slow"
    with pytest.raises(UnknownNameError, match=r"map\.toml: rate: unknown stream 'none'"):
        choose(full, LogMapping(preferred={"rate": "none"}, where="map.toml"))


def test_a_mapping_sets_delay_and_causality_of_the_readers_own_source(tmp_path: Path) -> None:
    named = tmp_path / "map.toml"
    named.write_text(
        'schema = "greybox.mapping/1"\n[rate]\nstream = "slow"\ndelay = 0.02\ncausal = false\n'
    )
    full = recording(slow=stream("slow", 20), fast=stream("fast", 200))
    source = choose(full, read_mapping(named))["rate"]
    assert (source.stream, source.delay, source.causal) == ("slow", 0.02, False)
    assert assemble(full, read_mapping(named)).noncausal == {"p", "q", "r"}


def test_a_delay_moves_a_stream_and_not_the_rows() -> None:
    t = 0.01 * np.arange(200)
    force = Stream(name="f", t=t, fields={"x": t, "y": t, "z": t})
    rate = Stream(name="g", t=t, fields={"x": t, "y": t, "z": t})
    sources = (
        Source(group="rate", stream="g", fields=("x", "y", "z")),
        Source(group="specific_force", stream="f", fields=("x", "y", "-z"), delay=0.03),
    )
    table = assemble(
        Recording(
            format="t", source="t", sha256="", streams={"f": force, "g": rate}, sources=sources
        )
    )
    np.testing.assert_allclose(table.columns["t"], t)
    # The sample stamped t was taken at t - 0.03: at row t stands the one stamped t + 0.03.
    np.testing.assert_allclose(table.columns["ax"][:190], t[:190] + 0.03)
    np.testing.assert_allclose(table.columns["az"][:190], -(t[:190] + 0.03))


def test_body_velocity_is_turned_by_the_attitude_of_its_own_time() -> None:
    t = 0.01 * np.arange(300)
    yaw = 1.5 * t
    attitude = {"w": np.cos(yaw / 2), "x": 0 * t, "y": 0 * t, "z": np.sin(yaw / 2)}
    late = t + 0.004
    moving = {"x": 2.0 + 0 * t, "y": 0 * t, "z": 0 * t}
    streams = {
        "pose": Stream(name="pose", t=t, fields=attitude),
        "speed": Stream(name="speed", t=late, fields=moving),
    }
    sources = (
        Source(group="attitude", stream="pose", fields=("w", "x", "y", "z")),
        Source(group="velocity", stream="speed", fields=("x", "y", "z"), frame="FLU"),
    )
    table = assemble(Recording(format="t", source="t", sha256="", streams=streams, sources=sources))
    inside = slice(2, 298)
    np.testing.assert_allclose(table.columns["vx"][inside], 2.0 * np.cos(yaw)[inside], atol=2e-4)
    np.testing.assert_allclose(table.columns["vy"][inside], 2.0 * np.sin(yaw)[inside], atol=2e-4)


def test_a_stream_of_another_clock_is_left_out_and_named_and_a_delay_brings_it_back(
    tmp_path: Path,
) -> None:
    gyro, force = stream("fast", 100), stream("force", 100, start=1.7e9)
    sources = (
        Source(group="rate", stream="fast", fields=("x", "y", "z")),
        Source(group="specific_force", stream="force", fields=("x", "y", "z")),
    )
    both = Recording(
        format="t", source="t", sha256="", streams={"fast": gyro, "force": force}, sources=sources
    )
    table = assemble(both)
    assert "ax" not in table.columns
    assert any("another clock" in n and "+1700000000.000 s" in n for n in table.notes)
    named = tmp_path / "map.toml"
    named.write_text('schema = "greybox.mapping/1"\n[specific_force]\ndelay = 1.7e9\n')
    assert np.isfinite(assemble(both, read_mapping(named)).columns["ax"]).mean() > 0.95
    sent = (sources[0], Source(group="command", stream="force", fields=("x", "y")))
    with pytest.raises(DataError, match=r"another clock.*\[command\] delay"):
        assemble(Recording(format="t", source="t", sha256="", streams=both.streams, sources=sent))


def test_stamps_that_jump_back_stay_visible_in_the_rows_and_do_no_harm_elsewhere() -> None:
    good = stream("fast", 100)
    broken = good.t.copy()
    broken[100:] -= 0.5
    gyro = Stream(name="fast", t=broken, fields=good.fields)
    table = assemble(recording(fast=gyro))
    assert (np.diff(table.columns["t"]) < 0).sum() == 1, "`greybox check` must see it"


def test_a_log_without_any_known_stream_says_what_it_holds() -> None:
    with pytest.raises(DataError, match=r"got temperature.*--mapping"):
        assemble(
            Recording(
                format="t",
                source="t.log",
                sha256="",
                streams={"temperature": stream("temperature", 10)},
            )
        )


@pytest.mark.parametrize(("whole", "part"), [("secs", "nsecs"), ("sec", "nanosec")])
def test_a_stamp_of_two_columns_is_one_time(whole: str, part: str, tmp_path: Path) -> None:
    """Tables of ROS messages have seconds, and nanoseconds in the second."""
    t = 0.01 * np.arange(250)
    stamps = {whole: 1.7e9 + np.floor(t), part: np.round(t % 1.0 * 1e9)}
    rows = {f"header.stamp.{n}": v for n, v in stamps.items()}
    rows |= {f"angular_velocity.{a}": np.sin(t) for a in "xyz"}
    w.write_csv(tmp_path / "a.csv", rows | {f"rpm_{i}": 9000.0 + t for i in range(4)})
    draft = tmp_path / "m.toml"
    main(["inspect", str(tmp_path / "a.csv"), "--draft", str(draft)])
    field = f"header.stamp.{whole} + header.stamp.{part}"
    assert tomllib.loads(draft.read_text())["time"] == {"field": field, "unit": "s"}
    raw = inspect_log(tmp_path / "a.csv", mapping=draft).raw
    assert raw is not None
    np.testing.assert_allclose(raw.t - raw.t[0], t, atol=1e-6)


def test_nanoseconds_that_count_on_are_no_part_of_a_second(tmp_path: Path) -> None:
    t = 10.0 + 0.01 * np.arange(250)
    rows = {"t_sec": np.floor(t), "t_nsec": 1e9 * t, "p": np.sin(t)}
    assert list(
        inspect_log(w.write_csv(tmp_path / "a.csv", rows)).recording.streams["table"].fields
    ) == list(rows)
