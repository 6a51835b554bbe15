"""The same real flight, written in every format, is read into the same channels, units, axes and
times."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from greybox.data.logs import read_log, read_logs, read_table
from greybox.data.raw import RawLog
from greybox.data.readers import read_recording
from tests.data.readers import writers as w

CASES: dict[str, tuple[str, Callable[[Path, dict[str, np.ndarray]], Path], str]] = {
    "px4": ("f.ulg", w.write_ulog, ""),
    "px4 before 1.13": ("f.ulg", lambda p, c: w.write_ulog(p, c, version="old"), ""),
    "px4 with a thrust curve": ("f.ulg", lambda p, c: w.write_ulog(p, c, thrust_factor=0.6), ""),
    "crazyflie": ("log00", w.write_crazyflie, ""),
    "crazyflie, old": ("log00", lambda p, c: w.write_crazyflie(p, c, version=1), ""),
    "betaflight": ("f.bbl", w.write_betaflight, ""),
    "ardupilot": ("f.bin", w.write_ardupilot, ""),
    "ros 1": ("f.bag", lambda p, c: w.write_ros(p, c, kind="bag"), w.ROS_MAPPING),
    "ros 2": ("bag", lambda p, c: w.write_ros(p, c, kind="sqlite"), w.ROS_MAPPING),
    "mcap": ("bag", lambda p, c: w.write_ros(p, c, kind="mcap"), w.ROS_MAPPING),
    "own csv": ("f.csv", lambda p, c: w.write_csv(p, w.own_columns(c)), w.OWN_MAPPING),
    "own parquet": ("f.parquet", lambda p, c: w.write_parquet(p, w.own_columns(c)), w.OWN_MAPPING),
    "own matlab": ("f.mat", lambda p, c: w.write_mat(p, w.own_columns(c)), w.OWN_MAPPING),
    "canonical parquet": ("f.parquet", w.write_parquet, ""),
    "canonical matlab": ("f.mat", w.write_mat, ""),
}

EXACT = {
    # Resolution of the format's own numbers: float32, deg/s as integers, 2048 counts per g, 2000
    # steps of a motor.
    "p": {"betaflight": 0.6 * np.pi / 180},
    "ax": {"betaflight": 0.6 * 9.81 / 2048},
    "u1": {"ardupilot": 6e-4, "betaflight": 0.6 / 1999, "crazyflie": 1e-5, "crazyflie, old": 1e-5},
    "vbat": {"betaflight": 0.006},
}
LIKE = {"q": "p", "r": "p", "ay": "ax", "az": "ax", "u2": "u1", "u3": "u1", "u4": "u1"}
FLOAT32 = 3e-6


def written(name: str, folder: Path, rows: int = 400) -> tuple[RawLog, dict[str, np.ndarray]]:
    pytest.importorskip(
        {"px4": "pyulog", "betaflight": "orangebox", "ros": "rosbags", "mcap": "rosbags"}.get(
            name.split()[0], "pyarrow" if "parquet" in name else "numpy"
        )
    )
    file, write, mapping = CASES[name]
    truth = w.channels(rows=rows)
    path = write(folder / file, truth)
    named = None
    if mapping:
        named = folder / "map.toml"
        named.write_text(mapping)
    return read_table(path, mapping=named), truth


@pytest.mark.parametrize("name", CASES)
def test_channels_are_the_same(name: str, tmp_path: Path) -> None:
    raw, truth = written(name, tmp_path)
    assert raw.n == truth["t"].size
    np.testing.assert_allclose(raw.t, truth["t"], atol=1e-3 if name == "crazyflie, old" else 2e-6)
    must = {"u1", "u4", "p", "q", "r", "ax", "ay", "az"}
    assert must <= set(raw.channels), raw.notes
    compared = 0
    quaternion = [k for k in ("qw", "qx", "qy", "qz") if k in raw.channels]
    if quaternion:
        # The writer's quaternions change sign at random; neighbours agree after reading.
        q = np.column_stack([raw.channels[k] for k in quaternion])
        q = q[np.isfinite(q).all(axis=1)]
        assert (np.sum(q[1:] * q[:-1], axis=1) > 0).all()
    sign = np.sign(sum(raw.channels[k] * truth[k] for k in quaternion)) if quaternion else 1.0
    for key, values in raw.channels.items():
        expected = truth[key] * (sign if key in quaternion else 1.0)
        here = np.isfinite(values) & np.isfinite(expected)
        # Between its samples the voltage is a line, a setpoint what was last sent.
        every = {"v": 20, "s": 10}.get(key[0] if key == "vbat" or key.startswith("sp_") else "", 1)
        here &= np.arange(raw.n) % (every if name.startswith("px4") else 1) == 0
        # A slow channel stands in single rows; all of its samples are there.
        assert here.sum() >= min(0.04 * raw.n, np.isfinite(expected).sum()) * 0.95, key
        assert (
            not name.startswith("px4")
            or key not in ("vbat", "sp_x")
            or np.isfinite(values).mean() > 0.9
        )
        tolerance = EXACT.get(LIKE.get(key, key), {}).get(
            name, FLOAT32 * max(1.0, float(np.nanmax(np.abs(expected))))
        )
        np.testing.assert_allclose(
            values[here], expected[here], atol=tolerance, rtol=1e-5, err_msg=f"{name}: {key}"
        )
        compared += 1
    assert compared >= 10


@pytest.mark.parametrize("name", ["px4", "crazyflie", "betaflight", "mcap", "own parquet"])
def test_a_vehicle_file_with_columns_of_its_own_csv_does_not_disturb(
    name: str, tmp_path: Path
) -> None:
    """`[columns]` of the vehicle file are about its tables; readers that know the channels are not
    asked twice."""
    pytest.importorskip(
        {"px4": "pyulog", "betaflight": "orangebox", "mcap": "rosbags"}.get(name, "pyarrow")
    )
    file, write, mapping = CASES[name]
    path = write(tmp_path / file, w.channels(rows=300))
    named = tmp_path / "map.toml"
    named.write_text(mapping)
    flight = read_log(path, w.vehicle(), mapping=named if mapping else None, trim=False)
    assert flight.name == path.name.rpartition(".")[0] or flight.name == path.name
    assert flight.segments[0].n > 250
    assert abs(flight.segments[0].dt - 0.01) < 1e-6


def test_what_a_reader_of_ones_own_hands_over_is_read_like_its_file(tmp_path: Path) -> None:
    file, write, _ = CASES["crazyflie"]
    path = write(tmp_path / file, w.channels(rows=400))
    handed, (theirs,) = read_log(path), read_logs(read_recording(path), rate=50.0).flights
    ours = read_log(read_recording(path))
    assert (ours.name, ours.sha256, ours.notes) == (handed.name, handed.sha256, handed.notes)
    for one, other in zip(ours.segments, handed.segments, strict=True):
        assert set(one.channels) == set(other.channels)
        for name, values in one.channels.items():
            np.testing.assert_array_equal(values, other.channels[name])
    assert theirs.segments[0].dt == 0.02
