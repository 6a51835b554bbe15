"""Tables of several rates in one folder, as ulog2csv and EuRoC's data sets write them, are the
streams of one log, and a folder of flights is none."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest

from greybox.cli import main
from greybox.data.column_guess import guess_streams
from greybox.data.inspection import inspect_log
from greybox.data.logs import read_log
from greybox.data.logs.csv import read_csv
from greybox.data.logs.table import Table
from greybox.data.readers import folder
from greybox.errors import DataError
from tests.data.readers import writers as w


def topics(folder: Path, c: w.Columns) -> Path:
    """A flight as ulog2csv writes it, with twelve outputs of which four are, and what is wanted."""
    frd = {n: np.column_stack(w.to_frd(c, n)) for n in (("p", "q", "r"), ("ax", "ay", "az"))}
    q = np.column_stack([c[f"q{a}"] for a in "wxyz"])
    volts = 3.9 + 0.0 * c["t"]

    def table(topic: str, names: list[str], values: np.ndarray, step: int = 1) -> None:
        us = np.round(412e6 + 1e6 * c["t"])
        rows = {"timestamp": us[::step], **dict(zip(names, values[::step].T, strict=True))}
        w.write_csv(folder / f"log_7_{topic}.csv", rows)

    folder.mkdir()
    xyz, unused = [f"xyz[{i}]" for i in range(3)], np.full((len(q), 8), np.nan)
    u = np.column_stack([c[f"u{i}"] for i in range(1, 5)])
    table("actuator_motors_0", [f"control[{i}]" for i in range(12)], np.hstack([u, unused]))
    table("vehicle_angular_velocity_0", xyz, frd["p", "q", "r"])
    table("vehicle_acceleration_0", xyz, frd["ax", "ay", "az"])
    table("vehicle_torque_setpoint_0", xyz, 0.1 * frd["p", "q", "r"])
    table("vehicle_attitude_0", [f"q[{i}]" for i in range(4)], q, 2)
    table("battery_status_0", ["voltage_v"], volts[:, None], 10)
    table("battery_status_1", ["voltage_v"], volts[:, None], 10)
    return folder


def test_the_draft_of_a_folder_reads_what_was_flown(tmp_path: Path) -> None:
    c = w.channels(rows=400)
    flown, draft = topics(tmp_path / "flown", c), tmp_path / "map.toml"
    assert main(["inspect", str(flown), "--draft", str(draft)]) == 1
    said = tomllib.loads(draft.read_text())
    assert {"command", "rate", "specific_force", "attitude", "battery"} <= set(said)
    assert said["rate"]["stream"] == "log_7_vehicle_angular_velocity_0"
    assert said["specific_force"]["frame"] == "FRD" and "NAME OF" not in draft.read_text()
    assert main(["inspect", str(flown), "--mapping", str(draft)]) == 0
    read = read_log(flown, mapping=draft, trim=False).segments[0].channels
    for name in ("u1", "u4", "p", "q", "r", "ax", "az"):
        np.testing.assert_allclose(read[name], c[name][: len(read[name])], atol=1e-5, err_msg=name)
    assert np.isfinite(read["vbat"]).mean() > 0.9


def test_columns_of_our_names_are_not_taken_for_ours_in_a_folder(tmp_path: Path) -> None:
    """PX4's x, y, z look north, east and down."""
    flown = tmp_path / "flown"
    flown.mkdir()
    rows = {"t": 0.01 * np.arange(50.0), "x": np.arange(50.0), "y": np.ones(50), "z": np.ones(50)}
    w.write_csv(flown / "vehicle_local_position_0.csv", rows)
    w.write_csv(flown / "other_0.csv", {"t": rows["t"], "w": rows["x"]})
    found = inspect_log(flown)
    assert found.raw is None and "nothing in it that greybox can name" in found.problem


def test_a_folder_of_flights_is_no_log(tmp_path: Path) -> None:
    c = w.channels(rows=100)
    rows = {n: c[n] for n in ("t", "u1", "u2", "u3", "u4", "p", "q", "r")}
    for name in ("a", "b"):
        w.write_csv(tmp_path / f"{name}.csv", rows)
        with pytest.raises(DataError, match=r"a folder, not a log.*name the log files"):
            inspect_log(tmp_path)


def test_of_a_folder_of_flights_two_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It may be larger than the memory."""
    c, read = w.channels(rows=100), []
    for name in "abcd":
        w.write_csv(tmp_path / f"{name}.csv", {n: c[n] for n in ("t", "u1", "u2", "u3", "u4", "p")})

    def counted(path: Path) -> Table:
        read.append(path.name)
        return read_csv(path)

    monkeypatch.setitem(folder._READ, ".csv", counted)
    with pytest.raises(DataError, match="flights a, b"):
        inspect_log(tmp_path)
    assert read == ["a.csv", "b.csv"]


@pytest.mark.parametrize("name", ["{0}/{1}.csv", "{0}_{1}_0.csv", "12_{0}0_00_{1}.csv"])
def test_the_tables_of_two_flights_are_no_log(name: str, tmp_path: Path) -> None:
    """Commands of one would be held against the pose of the other."""
    c = w.channels(rows=100)
    rows = {"motors": ["u1", "u2", "u3", "u4"], "imu": ["p", "q", "r"], "pose": ["x", "y", "z"]}

    def fly(flight: str, tables: list[str]) -> None:
        for table in tables:
            (tmp_path / name.format(flight, table)).parent.mkdir(exist_ok=True)
            columns = {n: c[n] for n in ("t", *rows[table])}
            w.write_csv(tmp_path / name.format(flight, table), columns)

    fly("1", ["motors", "imu", "pose"])
    fly("2", ["motors"])  # a motor's table twice is no flight
    assert inspect_log(tmp_path).format.name == "folder"
    fly("2", ["imu"])
    with pytest.raises(DataError, match=r"a folder, not a log.*flights"):
        inspect_log(tmp_path)


def test_of_tables_that_say_the_same_the_first_is_guessed() -> None:
    c = w.channels(rows=100)
    rates = {f"w_{axis}": c[name] for axis, name in zip("xyz", "pqr", strict=True)}
    (guess,) = guess_streams({"imu0/data": rates, "imu1/data": rates})
    assert guess.stream == "imu0/data"


def test_a_struct_of_parquet_is_a_column_per_field(tmp_path: Path) -> None:
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    t = 0.01 * np.arange(60)
    gyro = pa.array([{"x": v, "y": {"mean": 2 * v}} for v in t])
    pq.write_table(pa.table({"t": t, "gyro": gyro}), tmp_path / "a.parquet")
    fields = inspect_log(tmp_path / "a.parquet").recording.streams["table"].fields
    np.testing.assert_array_equal(fields["gyro.y.mean"], 2 * t)
