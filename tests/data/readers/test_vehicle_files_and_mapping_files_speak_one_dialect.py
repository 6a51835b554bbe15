"""`[columns.rate]` of a vehicle file and `[rate]` of a mapping file mean the same, and the older
form is read still."""

from __future__ import annotations

import json
import tomllib
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from greybox.cli import main
from greybox.data.logs import read_table
from greybox.data.raw import RawLog
from greybox.data.readers.mapping import LogMapping, mapping_of, mapping_text, read_mapping
from greybox.errors import DataError, OldFormWarning, UnknownNameError
from greybox.examples import flight_path, vehicle_path
from greybox.model.vehicle import Vehicle, read_vehicle
from tests.data.readers import writers as w

OLD = """[columns]
t = { name = "time_ms", scale = 1e-3 }
p = { name = "gyr_x", scale = 0.017453292519943295 }
q = { name = "gyr_y", scale = -0.017453292519943295 }
r = { name = "gyr_z", scale = -0.017453292519943295 }
u1 = { name = "pwm1", scale = 1e-3, offset = -1.0 }
u2 = { name = "pwm2", scale = 1e-3, offset = -1.0 }
u3 = { name = "pwm3", scale = 1e-3, offset = -1.0 }
u4 = { name = "pwm4", scale = 1e-3, offset = -1.0 }
vx = { name = "vicon_vx", causal = false }
"""

HEAD = 'schema = "greybox.mapping/1"\n'
GYRO = {"fields": ["gx", "gy", "gz"], "unit": "deg/s"}


def vehicle_file(path: Path, columns: str) -> Path:
    path.write_text(Path(vehicle_path("nanobench")).read_text().split("[columns.")[0] + columns)
    return path


def prefixed(mapping: str) -> str:
    return mapping.partition("\n")[2].replace("[", "[columns.", 1).replace("\n[", "\n[columns.")


def test_the_same_tables_in_either_file_give_the_same_channels(tmp_path: Path) -> None:
    log = w.write_csv(tmp_path / "own.csv", w.own_columns(w.channels(rows=300)))
    (tmp_path / "map.toml").write_text(w.OWN_MAPPING)
    vehicle = read_vehicle(vehicle_file(tmp_path / "v.toml", prefixed(w.OWN_MAPPING)))
    inside = read_table(log, vehicle)
    beside = read_table(log, replace(vehicle, columns=LogMapping()), mapping=tmp_path / "map.toml")
    assert set(inside.channels) == set(beside.channels) >= {"u1", "p", "ax", "qw", "x"}
    for name, values in inside.channels.items():
        np.testing.assert_array_equal(values, beside.channels[name], err_msg=name)


def test_a_mapping_comes_before_the_vehicle_file_and_leaves_it_the_rest(tmp_path: Path) -> None:
    vehicle = read_vehicle(vehicle_path("nanobench"))
    log = flight_path("nanobench", "B2_circle_fast_rep1")
    (tmp_path / "map.toml").write_text(
        'schema = "greybox.mapping/1"\n[rate]\nfields = ["imu_gyro_x", "-imu_gyro_y", '
        '"imu_gyro_z"]\n'
    )
    plain, turned = (
        read_table(log, vehicle),
        read_table(log, vehicle, mapping=tmp_path / "map.toml"),
    )
    np.testing.assert_array_equal(turned.channels["q"], -plain.channels["q"])
    for name in ("p", "u1", "az", "vx"):
        np.testing.assert_array_equal(turned.channels[name], plain.channels[name], err_msg=name)
    assert turned.noncausal == {"vx", "vy", "vz"}


def test_a_vehicle_file_names_streams_of_bags_and_what_a_log_lacks_is_said(tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    bag = w.write_ros(tmp_path / "bag", w.channels(rows=200), kind="mcap")
    vehicle = read_vehicle(
        vehicle_file(
            tmp_path / "v.toml", prefixed(w.ROS_MAPPING) + '[columns.position]\nstream = "/vicon"\n'
        )
    )
    raw = read_table(bag, vehicle)
    assert {"u1", "u4", "x"} <= set(raw.channels)
    assert "the log has no stream /vicon for the position" in raw.notes


def test_columns_that_name_no_stream_are_of_the_only_one_or_are_asked_for_it(
    tmp_path: Path,
) -> None:
    pytest.importorskip("orangebox")
    log = w.write_betaflight(tmp_path / "f.bbl", w.channels(rows=300))
    said = 'fields = ["motor[3]", "motor[1]", "motor[2]", "motor[0]"]\nlimits = [0, 4094]\n'
    vehicle = read_vehicle(vehicle_file(tmp_path / "v.toml", f"[columns.command]\n{said}"))
    own = read_table(log)
    (tmp_path / "map.toml").write_text(f"{HEAD}[command]\n{said}")
    for read in (read_table(log, vehicle), read_table(log, mapping=tmp_path / "map.toml")):
        counts = 48 + 1999 * own.channels["u4"]
        np.testing.assert_allclose(read.channels["u1"], counts / 4094, atol=1e-9)
    pytest.importorskip("rosbags")
    bag = w.write_ros(tmp_path / "bag", w.channels(rows=300))
    field = 'fields = ["angular_velocity.x", "angular_velocity.y", "angular_velocity.z"]\n'
    columns = f"{prefixed(w.ROS_MAPPING)}[columns.rate]\n{field}"
    vehicle = read_vehicle(vehicle_file(tmp_path / "v.toml", columns))
    assert any('say stream = "/imu"' in n for n in read_table(bag, vehicle).notes)


def test_a_log_in_our_names_is_read_with_the_vehicle_file_of_another_table(tmp_path: Path) -> None:
    """What `greybox inspect --out` wrote goes on with the vehicle file that the log came with."""
    c = w.channels(rows=200)
    raw = read_table(w.write_csv(tmp_path / "f.csv", c), read_vehicle(vehicle_path("nanobench")))
    np.testing.assert_array_equal(raw.channels["u1"], c["u1"])
    assert any("the log has no motor_motor_m1" in n for n in raw.notes)
    lost = {k: v for k, v in c.items() if k != "u3"} | {"motor_motor_m1": c["u3"]}
    with pytest.raises(UnknownNameError, match="motor_motor_m2"):
        read_table(w.write_csv(tmp_path / "g.csv", lost), read_vehicle(vehicle_path("nanobench")))


def test_rows_keep_their_numbers_their_stamps_and_their_other_columns(tmp_path: Path) -> None:
    c = w.own_columns(w.channels(rows=20)) | {"note": np.arange(20.0)}
    (tmp_path / "map.toml").write_text(w.OWN_MAPPING)
    raw = read_table(w.write_csv(tmp_path / "own.csv", c), mapping=tmp_path / "map.toml")
    np.testing.assert_array_equal(raw.extra["note"], c["note"])
    np.testing.assert_array_equal(raw.t, c["time_ms"] * 1e-3)
    assert raw.rows[0] == 2
    for cell, said in (("fast", "row 7, column 'gyr_y'"), ("inf", r"row 7, column 'gyr_y' \(q\)")):
        lines = (tmp_path / "own.csv").read_text().splitlines()
        cells = lines[6].split(",")
        cells[lines[0].split(",").index("gyr_y")] = cell
        (tmp_path / "bad.csv").write_text(
            "\n".join([*lines[:6], ",".join(cells), *lines[7:]]) + "\n"
        )
        with pytest.raises(ValueError, match=said):
            read_table(tmp_path / "bad.csv", mapping=tmp_path / "map.toml")


def test_the_form_by_channel_is_read_says_so_once_and_is_printed_anew(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = vehicle_file(tmp_path / "v.toml", OLD)
    with warnings.catch_warnings():
        warnings.simplefilter("default")  # as in the interpreter of a user
        assert main(["vehicle", "check", str(path)]) == 0
    out, err = capsys.readouterr()
    assert err.count("\n") == 1
    assert "goes with 0.2.0" in err
    new = out[out.index("[columns.") : out.index("\n\n")]
    with pytest.warns(OldFormWarning, match="greybox vehicle check"):
        old = read_vehicle(path)
    again = read_vehicle(vehicle_file(tmp_path / "n.toml", new))
    assert again.columns == old.columns
    log = w.write_csv(tmp_path / "own.csv", w.own_columns(w.channels(rows=200)))
    by_mapping = tmp_path / "map.toml"
    by_mapping.write_text(w.OWN_MAPPING)
    raw, meant = read_table(log, old), read_table(log, mapping=by_mapping)
    for name in ("u1", "u4", "p", "q", "r"):
        np.testing.assert_allclose(raw.channels[name], meant.channels[name], rtol=1e-12, atol=1e-12)


def test_what_older_model_files_hold_is_read_without_a_word() -> None:
    old = tomllib.loads(OLD)["columns"]
    plain = read_vehicle(vehicle_path("nanobench")).to_dict()
    vehicle = Vehicle.from_dict({**plain, "columns": old})
    assert vehicle.columns.sources["rate"].fields == ("gyr_x", "-gyr_y", "-gyr_z")
    assert Vehicle.from_dict(json.loads(json.dumps(vehicle.to_dict()))) == vehicle


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    said = mapping_of(
        {
            "clock": "/imu",
            "time": {"field": 'a "b"\x7f', "unit": "us", "scale": 2.0, "offset": 0.5},
            "rate": {
                "fields": ["x", "-y", ""],
                "stream": "/imu",
                "unit": "deg/s",
                "frame": "FRD",
                "delay": 0.01,
            },
            "command": {
                "fields": ["a", "b"],
                "limits": [1000, 2000],
                "scale": [1.0, 2.0],
                "offset": [0.0, 1e-9],
            },
            "position": {"stream": "/mocap", "causal": False},
            "battery": {"use": False},
        },
        where="here",
    )
    path = tmp_path / "map.toml"
    path.write_text(mapping_text({"schema": "greybox.mapping/1", **said.to_dict()}))
    assert read_mapping(path) == said


def lag(raw: RawLog, name: str) -> float:
    """By how much a 1 Hz sine is late on the clock of the log [s]."""
    good = np.isfinite(raw.channels[name])
    phase = 2 * np.pi * raw.t[good]
    waves = np.column_stack([np.sin(phase), np.cos(phase), np.ones(phase.size)])
    a, b, _ = np.linalg.lstsq(waves, raw.channels[name][good], rcond=None)[0]
    return float(-np.arctan2(b, a) / (2 * np.pi))


@pytest.mark.parametrize("named", ["", '[velocity]\nfields = ["vx", "vy", "vz"]\n'])
def test_a_delay_of_one_group_of_a_table_shifts_it_against_all_others(
    tmp_path: Path, named: str
) -> None:
    t = 0.01 * np.arange(300)
    wave, late = np.sin(2 * np.pi * t), np.sin(2 * np.pi * (t - 0.05))
    commands = {f"u{i}": 0.5 + 0.1 * wave for i in (1, 2, 3, 4)}
    c = {
        "t": t,
        **commands,
        "p": late,
        "q": late,
        "r": late,
        "vx": wave,
        "vy": wave,
        "vz": wave,
        "z": wave,
    }
    (tmp_path / "map.toml").write_text(
        HEAD + '[rate]\nfields = ["p", "q", "r"]\ndelay = 0.05\n' + named
    )
    raw = read_table(w.write_csv(tmp_path / "f.csv", c), mapping=tmp_path / "map.toml")
    assert [lag(raw, n) for n in ("p", "u1", "vx", "z")] == pytest.approx([0.0] * 4, abs=1e-4)
    c["p"][7] = np.inf
    with pytest.raises(ValueError, match=r"row 9, column 'p'"):
        read_table(w.write_csv(tmp_path / "g.csv", c), mapping=tmp_path / "map.toml")


@pytest.mark.parametrize(
    ("first", "second", "meant"),
    [
        ({"unit": "ms"}, {"field": "stamp"}, {"field": "stamp", "unit": "ms"}),
        (
            {"scale": 1e-3},
            {"field": "stamp", "offset": 2.0},
            {"field": "stamp", "scale": 1e-3, "offset": 2.0},
        ),
        (
            {"offset": 0.5},
            {"field": "stamp", "unit": "us"},
            {"field": "stamp", "unit": "us", "offset": 0.5},
        ),
        ({"scale": 1.0}, {"field": "stamp", "scale": 1e-3}, {"field": "stamp", "scale": 1.0}),
        ({"unit": "us"}, {"field": "stamp", "scale": 1e-3}, {"field": "stamp", "unit": "us"}),
        (
            {"field": "clock_s"},
            {"field": "stamp", "unit": "us", "offset": 2.0},
            {"field": "clock_s"},
        ),
    ],
)
def test_a_time_of_both_files_is_merged_key_by_key(
    first: dict[str, object], second: dict[str, object], meant: dict[str, object]
) -> None:
    """A unit takes the place of a scale, and another column has a unit of its own."""
    merged = mapping_of({"time": first}, where="map").over(
        mapping_of({"time": second}, where="vehicle")
    )
    assert merged.to_dict() == {"time": meant}


@pytest.mark.parametrize(
    ("mine", "theirs", "meant"),
    [
        ({"delay": 0.01}, GYRO, {**GYRO, "delay": 0.01}),
        (
            {"stream": "/imu", "causal": False},
            {**GYRO, "stream": "/imu"},
            {**GYRO, "stream": "/imu", "causal": False},
        ),
        ({"stream": "/imu2", "delay": 0.01}, GYRO, {"stream": "/imu2", "delay": 0.01}),
        (
            {"delay": 0.01},
            {"stream": "/imu", "causal": False},
            {"stream": "/imu", "causal": False, "delay": 0.01},
        ),
        ({"stream": "/imu"}, {"causal": False}, {"stream": "/imu", "causal": False}),
        ({"fields": ["a", "b", "c"]}, GYRO, {"fields": ["a", "b", "c"]}),
        ({"use": False}, GYRO, {"use": False}),
    ],
)
def test_a_mapping_without_fields_keeps_those_of_the_vehicle_file(
    mine: dict[str, object], theirs: dict[str, object], meant: dict[str, object]
) -> None:
    """Their unit too, unless another stream is named: degrees must not become radians unseen."""
    merged = mapping_of({"rate": mine}, where="map").over(
        mapping_of({"rate": theirs}, where="vehicle")
    )
    assert merged.to_dict() == {"rate": meant}


def test_quaternions_of_a_table_that_are_not_of_unit_length_are_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    c = w.channels(rows=200)
    values = {k: 30 * c.pop(k) for k in ("qw", "qx", "qy", "qz")}
    log = w.write_csv(tmp_path / "f.csv", {**c, **dict(zip("abcd", values.values(), strict=True))})
    columns = '[columns.attitude]\nfields = ["a", "b", "c", "d"]\n'
    for delay in ("", "delay = 0.005\n"):
        assert (
            main(
                [
                    "check",
                    "--vehicle",
                    str(vehicle_file(tmp_path / "v.toml", columns + delay)),
                    str(log),
                ]
            )
            != 0
        )
        said = capsys.readouterr().out
        assert "quaternion(s) not of unit length" in said
        assert "holds no value" not in said


def test_the_unit_of_a_time_is_never_guessed(tmp_path: Path) -> None:
    c = w.channels(rows=200)
    t = c.pop("t")
    rate = HEAD + '[rate]\nfields = ["p", "q", "r"]\n'

    def step(column: str, scale: float, text: str) -> float:
        (tmp_path / "map.toml").write_text(text)
        log = w.write_csv(tmp_path / "f.csv", {column: scale * t, **c})
        return float(np.diff(read_table(log, mapping=tmp_path / "map.toml").t)[0])

    for column, scale in (("time", 1.0), ("t_s", 1.0), ("timestamp_us", 1e6), ("time_ms", 1e3)):
        assert step(column, scale, rate) == pytest.approx(0.01)
    with pytest.raises(DataError, match="no column 't' for the time; got columns timestamp"):
        step("timestamp", 1e6, rate)
    assert step(
        "timestamp", 1e6, rate + '[time]\nfield = "timestamp"\nunit = "us"\n'
    ) == pytest.approx(0.01)
    assert step(
        "time_ms", 1e3, rate + '[time]\nfield = "time_ms"\nscale = 1e-3\n'
    ) == pytest.approx(0.01)


def test_the_unit_of_a_time_that_is_not_there_is_not_that_of_another(tmp_path: Path) -> None:
    c = w.channels(rows=200)
    columns = '[columns.time]\nfield = "stamp"\nunit = "ms"\noffset = 3.0\n'
    raw = read_table(
        w.write_csv(tmp_path / "f.csv", c), read_vehicle(vehicle_file(tmp_path / "v.toml", columns))
    )
    np.testing.assert_array_equal(raw.t, c["t"])


def test_inspect_is_silent_on_vehicle_files_that_nobody_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    vehicle_file(tmp_path / "v.toml", OLD)
    log = w.write_csv(tmp_path / "f.csv", w.channels(rows=200))
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        main(["inspect", str(log)])
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("columns", "said"),
    [
        ({"rate": {"fields": ["a", "b"]}}, "columns.rate: 2 fields"),
        ({"rat": {}}, "unknown key 'rat'"),
        ({"p": "x", "rate": {"fields": ["a", "b", "c"]}}, "unknown channel 'rate'"),
        (
            {"command": {"fields": ["a", "b", "c", "d", "e"]}},
            "columns.command.fields: the vehicle has 4 rotors",
        ),
        ({"u5": "x"}, "columns.u5: the vehicle has 4 rotors"),
        (
            {"rate": {"fields": ["a", "b", "c"], "scale": [1.0, 2.0]}},
            "2 numbers; expected one, or one for each of 3",
        ),
        (
            {"rate": {"fields": ["a", "b", "c"], "scale": 0.0}},
            "columns.rate.scale: must not be zero",
        ),
        ({"rate": {"fields": ["", "", ""]}}, "columns.rate: fields; expected a list of names"),
    ],
)
def test_a_wrong_table_is_one_line_that_names_the_key(
    columns: dict[str, object], said: str
) -> None:
    plain = read_vehicle(vehicle_path("nanobench")).to_dict()
    with pytest.raises((ValueError, KeyError)) as error:
        Vehicle.from_dict({**plain, "columns": columns})
    assert said in str(error.value)
