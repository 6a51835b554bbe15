"""What is particular to one system: stamps and types of ROS, headers of blackbox files, structs,
units and signs."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from greybox.data.inspection import inspect_log
from greybox.data.logs import read_table
from greybox.data.logs.csv import read_csv
from greybox.data.readers import format_of, read_recording
from greybox.data.readers.matlab import read_mat
from greybox.errors import GreyboxError
from greybox.examples import flight_path
from tests.data.readers import writers as w

N = 200


def mapping(folder: Path, text: str) -> Path:
    path = folder / "map.toml"
    path.write_text('schema = "greybox.mapping/1"\n' + text)
    return path


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        ("a.bin", b"ULog\x01\x12\x35\x01" + bytes(8), "ulog"),
        ("a.txt", b"H Product:Blackbox flight data recorder\n", "betaflight"),
        ("LOG07", b"\xbc\x02\x00\x01\x00", "crazyflie"),
        ("LOG1", b"\xa3\x95\x80\x80\x59FMT\0", "ardupilot"),
        ("a.csv", b"PAR1....", "parquet"),
        ("a", b"MATLAB 5.0 MAT-file, Platform", "matlab"),
        ("a", b"\x89MCAP0\r\n", "ros"),
        ("a", b"#ROSBAG V2.0\n", "ros"),
        ("a.xyz", b"t,u1\n", "csv"),
        ("a.csv.gz", b"\x1f\x8b", "csv"),
    ],
)
def test_a_format_is_known_by_its_bytes_whatever_its_name(
    name: str, content: bytes, expected: str, tmp_path: Path
) -> None:
    (tmp_path / name).write_bytes(content)
    assert format_of(tmp_path / name).name == expected


# ROS ----------------------------------------------------------------------------------------------------------------


def test_header_stamps_are_taken_and_the_reception_is_told(tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    path = w.write_ros(tmp_path / "f.bag", w.channels(rows=N), kind="bag", received_late=0.03)
    streams = read_recording(path).streams
    assert "header stamp (received 30 ms later" in streams["/imu"].clock
    assert streams["/motors"].clock == "time of reception"
    np.testing.assert_allclose(np.diff(streams["/imu"].t), 0.01, atol=1e-6)


def test_a_bag_file_inside_its_folder_and_on_its_own_are_the_same(tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    folder = w.write_ros(tmp_path / "bag", w.channels(rows=N), kind="mcap")
    named = mapping(tmp_path, w.ROS_MAPPING.partition("\n")[2])
    whole = read_table(folder, mapping=named)
    alone = read_table(next(folder.glob("*.mcap")), mapping=named)
    np.testing.assert_array_equal(whole.channels["p"], alone.channels["p"])
    np.testing.assert_array_equal(whole.channels["u3"], alone.channels["u3"])


def test_json_in_mcap_is_read(tmp_path: Path) -> None:
    pytest.importorskip("mcap")
    from mcap.writer import Writer

    path = tmp_path / "j.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema(name="State", encoding="jsonschema", data=b"{}")
        channel = writer.register_channel(topic="/state", message_encoding="json", schema_id=schema)
        for k in range(50):
            message = {
                "gyro": [0.1 * k, 0.0, -0.1],
                "motors": {"front": 0.5, "rear": 0.6},
                "mode": "hover",
            }
            stamp = 10_000_000 * k
            writer.add_message(
                channel, log_time=stamp, publish_time=stamp, data=json.dumps(message).encode()
            )
        writer.finish()
    found = read_recording(path).streams["/state"]
    assert set(found.fields) == {"gyro[0]", "gyro[1]", "gyro[2]", "motors.front", "motors.rear"}
    assert found.unread == ("mode",)
    named = mapping(
        tmp_path,
        '[rate]\nstream = "/state"\nfields = ["gyro[0]", "gyro[1]", "-gyro[2]"]\n'
        '[command]\nstream = "/state"\nfields = ["motors.front", "motors.rear"]\n',
    )
    raw = read_table(path, mapping=named)
    np.testing.assert_allclose(raw.channels["p"], 0.1 * np.arange(50))
    assert raw.channels["r"][0] == 0.1
    assert raw.channels["u2"][0] == 0.6


def as_json(path: Path, topics: dict[str, tuple[str, np.ndarray, dict[str, Any]]]) -> Path:
    """An MCAP file with messages of JSON: topic -> (type, stamps [us], fields (N,) or (N, k))."""
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        for topic, (kind, stamps, fields) in topics.items():
            schema = writer.register_schema(name=kind, encoding="jsonschema", data=b"{}")
            channel = writer.register_channel(
                topic=topic, message_encoding="json", schema_id=schema
            )
            for k, stamp in enumerate(stamps.astype(int).tolist()):
                message = {"timestamp": stamp} | {n: v[k].tolist() for n, v in fields.items()}
                late = 1000 * stamp + 10**15
                writer.add_message(
                    channel, log_time=late, publish_time=late, data=json.dumps(message).encode()
                )
        writer.finish()
    return path


def test_px4_messages_in_a_bag_are_read_as_those_of_its_own_log(tmp_path: Path) -> None:
    pytest.importorskip("mcap")
    c = w.channels(rows=N)
    stamps = np.rint((c["t"] + 50.0) * 1e6)
    span, unknown = np.full(N, 4000), np.zeros(N, dtype=int)
    motors = np.column_stack([c[f"u{i}"] for i in (1, 2, 3, 4)])
    rpm = 1000.0 * (1.0 + np.arange(4)) + 0 * c["t"][:, None]
    sensors = {
        "gyro_rad": np.column_stack(w.to_frd(c, ("p", "q", "r"))),
        "gyro_integral_dt": span,
        "accelerometer_m_s2": np.column_stack(w.to_frd(c, ("ax", "ay", "az"))),
        "accelerometer_integral_dt": span,
    }
    attitude = {"q": w.px4_attitude(c), "timestamp_sample": unknown}
    topics = {
        "/fmu/in/actuator_motors": ("ActuatorMotors", stamps, {"control": motors}),
        # a mean over 4 ms belongs to the middle of them
        "/fmu/out/sensor_combined": ("SensorCombined", stamps + 2000, sensors),
        # what tells no time of its sample has that of its message
        "/fmu/out/vehicle_attitude": ("VehicleAttitude", stamps, attitude),
        "/fmu/out/actuator_outputs": ("ActuatorOutputs", stamps, {"output": 1000 + 1000 * motors}),
        "/fmu/out/esc_status": (
            "EscStatus",
            stamps,
            {f"esc[{i}].esc_rpm": rpm[:, i] for i in range(4)},
        ),
    }
    kinds = {n: (f"px4_msgs/msg/{k}", t, f) for n, (k, t, f) in topics.items()}
    raw = read_table(as_json(tmp_path / "f.mcap", kinds))
    for name in ("p", "q", "r", "ax", "az", "u1", "u4"):
        np.testing.assert_allclose(raw.channels[name], c[name], atol=1e-9, err_msg=name)
    alike = sum(raw.channels[k] * c[k] for k in ("qw", "qx", "qy", "qz"))
    np.testing.assert_allclose(np.abs(alike), 1.0, atol=1e-5)
    assert any("before THR_MDL_FAC and idle" in n for n in raw.notes)
    assert not any(n.startswith("omega") for n in raw.channels), "Gazebo's are its commands"


# ArduPilot ----------------------------------------------------------------------------------------------------------


def test_servo_functions_put_the_motors_in_order(tmp_path: Path) -> None:
    c = w.channels(rows=N)
    found = read_recording(w.write_ardupilot(tmp_path / "f.bin", c))
    (command,) = (s for s in found.sources if s.group == "command")
    assert command.fields == ("C2", "C1", "C4", "C3")  # functions 33 to 36
    assert "IMU[1]" in found.streams
    assert {s.stream for s in found.sources if s.group == "rate"} == {"IMU[0]"}


def test_a_damaged_onboard_log_is_read_around_the_damage(tmp_path: Path) -> None:
    path = w.write_ardupilot(tmp_path / "f.bin", w.channels(rows=N))
    whole = path.read_bytes()
    path.write_bytes(whole[:-5])
    assert read_recording(path).notes == ()
    place = whole.index(b"\xa3\x95\x82", len(whole) // 2)
    path.write_bytes(whole[:place] + bytes(700) + whole[place + 20 :])
    found = read_recording(path)
    assert "bytes between messages are not read" in found.notes[0]
    assert found.streams["IMU[0]"].n >= N - 2


@pytest.mark.parametrize(
    "pwm_range",
    [
        (),
        (("MOT_PWM_MIN", 0.0), ("MOT_PWM_MAX", 0.0)),
        (("MOT_PWM_MIN", 1900.0), ("MOT_PWM_MAX", 1100.0)),
    ],
)
def test_a_range_that_the_log_does_not_tell_is_called_assumed(
    tmp_path: Path, pwm_range: tuple[tuple[str, float], ...]
):
    found = read_recording(w.write_ardupilot(tmp_path / "f.bin", w.channels(rows=50), pwm_range))
    (command,) = (s for s in found.sources if s.group == "command")
    assert command.limits == (1000.0, 2000.0)
    assert "assumed" in command.note
    sound = read_recording(w.write_ardupilot(tmp_path / "g.bin", w.channels(rows=50)))
    assert "assumed" not in " ".join(s.note for s in sound.sources)


def test_messages_that_cannot_be_read_are_named_and_hide_no_message(tmp_path: Path) -> None:
    """A field of an unknown kind, with bytes in it that look like a message of the gyro."""
    path = w.write_ardupilot(tmp_path / "f.bin", w.channels(rows=50))
    whole = path.read_bytes()
    at = whole.index(b"\xa3\x95\x82")
    imu = whole[at : at + 36]
    unknown = b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", 0xF0, 43, b"ODD", b"Q?", b"TimeUS,What")
    path.write_bytes(
        whole[:at] + unknown + 5 * (b"\xa3\x95\xf0" + imu.ljust(40, b"\0")) + whole[at:]
    )
    found, sound = (
        read_recording(path),
        read_recording(w.write_ardupilot(tmp_path / "g.bin", w.channels(rows=50))),
    )
    (note,) = found.notes
    assert "messages ODD are not read" in note
    assert found.streams["IMU[0]"].n == sound.streams["IMU[0]"].n


def test_the_library_of_others_reads_the_same_numbers(tmp_path: Path) -> None:
    reader = pytest.importorskip("pymavlink.DFReader")
    path = w.write_ardupilot(tmp_path / "f.bin", w.channels(rows=50))
    theirs = reader.DFReader_binary(str(path))
    rows = []
    while (message := theirs.recv_match(type=["IMU"])) is not None:
        rows.append((message.I, message.TimeUS * 1e-6, message.GyrX, message.AccZ))
    ours = read_recording(path).streams
    for which in (0, 1):
        stream = ours[f"IMU[{which}]"]
        table = np.column_stack([stream.t, stream.fields["GyrX"], stream.fields["AccZ"]])
        np.testing.assert_array_equal(table, [row[1:] for row in rows if row[0] == which])


# Betaflight ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("headers", "expected"),
    [
        ({}, {"p": 1.0, "u1": 1.0}),
        ({"gyro_scale": "0x3d79c190"}, {"p": 0.0609756, "u1": 1.0}),
        ({"blackbox_high_resolution": "0"}, {"p": 1.0, "u1": 1.0}),
        ({"blackbox_high_resolution": "1"}, {"p": 0.1, "u1": 1.0}),
        ({"motorOutput": "158,2047"}, {"p": 1.0, "u1": 1.0}),
        ({"motorOutput": "158,1647", "motor_output_limit": "80"}, {"p": 1.0, "u1": 1.0}),
        ({"motorOutput": "1055,2000", "maxthrottle": "2000"}, {"p": 1.0, "u1": 1999 / 1000}),
        ({"motorOutput": "1070,1684", "maxthrottle": "1850"}, {"p": 1.0, "u1": 1999 / 850}),
    ],
)
def test_headers_say_what_the_counts_are(
    headers: dict[str, str], expected: dict[str, float], tmp_path: Path
) -> None:
    pytest.importorskip("orangebox")
    c = w.channels(rows=N)
    raw = read_table(w.write_betaflight(tmp_path / "f.bbl", c, headers=headers))
    measured, known = raw.channels["p"], np.deg2rad(np.rint(np.rad2deg(c["p"])))
    np.testing.assert_allclose(measured, known * expected["p"], atol=1e-6)
    assert np.ptp(raw.channels["u1"]) == pytest.approx(np.ptp(c["u1"]) * expected["u1"], abs=2e-3)


def test_rotors_that_may_turn_backwards_ask_for_their_range(tmp_path: Path) -> None:
    pytest.importorskip("orangebox")
    path = w.write_betaflight(tmp_path / "f.bbl", w.channels(rows=N), headers={"features": "4096"})
    raw = read_table(path)
    assert "u1" not in raw.channels
    assert any("turn backwards (feature 3D); give [command] limits" in n for n in raw.notes)


@pytest.mark.parametrize(
    ("output", "stopped"), [("158,2047", 0), ("1055,2000", 1000)], ids=["DShot", "pulses"]
)
def test_a_stopped_motor_is_a_command_of_zero(output: str, stopped: int, tmp_path: Path) -> None:
    """The firmware writes motor[0] less its least output as 32 bits without a sign."""
    pytest.importorskip("orangebox")
    idle = float(output.partition(",")[0])
    motor = np.where(np.arange(N) < N // 2, stopped, idle)
    fields = {"time": np.arange(N) * 1e3, **{f"gyroADC[{i}]": np.zeros(N) for i in range(3)}}
    fields |= {f"motor[{i}]": motor for i in range(4)}
    path = tmp_path / "f.bbl"
    headers = {"motorOutput": output, "maxthrottle": "2000"}
    path.write_bytes(w.blackbox_bytes(fields, headers, least=int(idle)))
    raw = read_table(path)
    low, high = (48, 2047) if stopped == 0 else (1000, 2000)
    for k in (1, 2):
        assert (raw.channels[f"u{k}"][: N // 2] == 0).all()
        known = (idle - low) / (high - low)
        np.testing.assert_allclose(raw.channels[f"u{k}"][N // 2 :], known, atol=1e-9)


def test_the_clock_goes_on_where_its_counter_begins_anew(tmp_path: Path) -> None:
    pytest.importorskip("orangebox")
    stamps = (2**32 - 50_000 + 1000 * np.arange(N)) % 2**32
    assert np.any(np.diff(stamps) < 0)
    signed = np.where(stamps < 2**31, stamps, stamps - 2**32)  # as the writer packs 32 bits
    fields = {"time": signed, **{f"gyroADC[{i}]": np.arange(N) for i in range(3)}}
    path = tmp_path / "f.bbl"
    path.write_bytes(w.blackbox_bytes(fields, {"Firmware revision": "Betaflight 4.5.1 (a) S"}))
    np.testing.assert_allclose(np.diff(read_table(path).t), 1e-3, atol=1e-9)


def test_an_attitude_without_w_is_whole(tmp_path: Path) -> None:
    pytest.importorskip("orangebox")
    c = w.channels(rows=N)
    q = np.column_stack([c[k] for k in ("qw", "qx", "qy", "qz")])
    q[::7] *= -1.0  # the same attitude
    logged = np.where(q[:, :1] < 0, -q, q)[:, 1:] * 32767
    fields = {"time": c["t"] * 1e6, **{f"gyroADC[{i}]": np.zeros(N) for i in range(3)}}
    fields |= {f"imuQuaternion[{i}]": logged[:, i] for i in range(3)}
    path = tmp_path / "f.bbl"
    path.write_bytes(w.blackbox_bytes(fields, {"Firmware revision": "Betaflight 4.6.0 (a) S"}))
    raw = read_table(path)
    read = np.column_stack([raw.channels[k] for k in ("qw", "qx", "qy", "qz")])
    assert np.abs(np.sum(read * q, axis=1)).min() > 1.0 - 1e-6


def test_rotor_speed_and_an_old_battery_field_need_their_headers(tmp_path: Path) -> None:
    pytest.importorskip("orangebox")
    n = 60
    fields = {"time": 1e3 * np.arange(n), "eRPM[0]": np.full(n, 350), "eRPM[1]": np.full(n, 420)}
    fields |= {"vbatLatest": np.full(n, 165), **{f"gyroADC[{i}]": np.zeros(n) for i in range(3)}}
    path = tmp_path / "f.bbl"
    path.write_bytes(
        w.blackbox_bytes(
            fields, {"motor_poles": "14", "Firmware revision": "Betaflight 4.3.0 (abc) S"}
        )
    )
    raw = read_table(path)
    assert raw.channels["omega1"][0] == pytest.approx(35000 / 7 * np.pi / 30)
    assert raw.channels["vbat"][0] == pytest.approx(1.65)
    path.write_bytes(w.blackbox_bytes(fields, {"Firmware revision": "Betaflight 3.5.7 (abc) S"}))
    raw = read_table(path)
    assert "vbat" not in raw.channels and "omega1" not in raw.channels
    assert any("no fixed unit before Betaflight 4.0" in n for n in raw.notes)
    assert any("motor_poles is not in the header" in n for n in raw.notes)


def test_a_chirp_of_the_firmware_is_named(tmp_path: Path) -> None:
    pytest.importorskip("orangebox")
    fields = {"time": np.arange(N) * 2000.0, "gyroADC[0]": np.zeros(N), "debug[0]": np.zeros(N)}
    settings = {"Firmware revision": "Betaflight 2025.12.1 (abc) S", "chirp_amplitude_roll": "230"}
    (tmp_path / "f.bbl").write_bytes(w.blackbox_bytes(fields, settings))
    found = read_recording(tmp_path / "f.bbl")
    assert found.info["chirp_amplitude_roll"] == "230"
    assert any("phase of the chirp" in note for note in found.notes)


def test_a_chirp_of_the_firmware_becomes_a_column(tmp_path: Path) -> None:
    pytest.importorskip("orangebox")
    phase = np.concatenate(
        [np.zeros(N // 4), np.cumsum(np.linspace(0.02, 0.8, N - N // 4)) % (2 * np.pi)]
    )
    fields = {
        "time": np.arange(N) * 2000.0,
        "gyroADC[0]": np.zeros(N),
        "gyroADC[1]": np.zeros(N),
        "gyroADC[2]": np.zeros(N),
    }
    settings = {"Firmware revision": "Betaflight 2025.12.1 (abc) S", "chirp_amplitude_roll": "230"}
    other = (np.rint(5000 * phase[::-1]), np.arange(N) * 400.0)
    for values, there in ((np.rint(5000 * phase), True), *((v, False) for v in other)):
        (tmp_path / "f.bbl").write_bytes(w.blackbox_bytes({**fields, "debug[0]": values}, settings))
        extra = read_table(tmp_path / "f.bbl").extra
        assert ("chirp" in extra) == there
        if there:
            known = np.where(phase > 0, np.cos(phase), 0.0)
            np.testing.assert_allclose(extra["chirp"], known, atol=2e-4)


def test_of_several_flights_in_a_file_the_longest_is_read(tmp_path: Path) -> None:
    pytest.importorskip("orangebox")
    parts = [
        w.write_betaflight(tmp_path / "f.bbl", w.channels(rows=rows)).read_bytes()
        for rows in (60, N, 90)
    ]
    (tmp_path / "all.bbl").write_bytes(b"".join(parts))
    raw = read_table(tmp_path / "all.bbl")
    assert raw.n == N
    assert any("flight 2 of the 3" in n for n in raw.notes)


# ArduPilot ----------------------------------------------------------------------------------------------------------


def test_samples_that_are_written_together_keep_the_time_of_each(tmp_path: Path) -> None:
    """A FIFO is read eight samples at a time; TimeUS is when they were written."""
    sampled = 1_000_000 + 500 * np.arange(N)
    written = sampled[7::8].repeat(8)[:N] + 40
    kept = sampled[: written.size]
    turning = np.sin(2e-5 * (kept - kept[0]))
    rows = [
        (int(t), 0, int(s), float(v), -float(v), 0.5)
        for t, s, v in zip(written, kept, turning, strict=True)
    ]
    path = tmp_path / "a.bin"
    path.write_bytes(
        w.dataflash_bytes([("GYR", "QBQfff", "TimeUS,I,SampleUS,GyrX,GyrY,GyrZ", rows)])
    )
    raw = read_table(path)
    np.testing.assert_allclose(np.diff(raw.t), 5e-4, atol=1e-9)
    np.testing.assert_allclose(raw.channels["p"], turning, atol=1e-6)


def test_the_estimate_that_the_craft_flew_by_is_read(tmp_path: Path) -> None:
    stamps = [10_000 * k for k in range(1, 61)]
    half = float(np.sqrt(0.5))
    turned = [
        (t, core, *q) for t in stamps for core, q in enumerate(((1.0, 0, 0, 0), (half, half, 0, 0)))
    ]
    for primary in (0, 1):
        gyro = [(t, 0, 0.1, 0.2, 0.3) for t in stamps]
        chosen = [(t, core, primary) for t in stamps for core in (0, 1)]
        path = tmp_path / "a.bin"
        path.write_bytes(
            w.dataflash_bytes(
                [
                    ("IMU", "QBfff", "TimeUS,I,GyrX,GyrY,GyrZ", gyro),
                    ("XKQ", "QBffff", "TimeUS,C,Q1,Q2,Q3,Q4", turned),
                    ("XKF4", "QBb", "TimeUS,C,PI", chosen),
                ]
            )
        )
        note = next(n for n in read_table(path).notes if n.startswith("qw"))
        assert f"XKQ[{primary}]" in note


# Crazyflie ----------------------------------------------------------------------------------------------------------


def test_events_of_two_rates_meet_and_a_check_sum_that_is_wrong_is_told(tmp_path: Path) -> None:
    c = w.channels(rows=N)
    stamps = np.rint(c["t"] * 1e6)
    gyro = np.column_stack([np.rad2deg(c[k]) for k in "pqr"])
    euler = np.column_stack([10.0 + 0 * c["t"], 20.0 + 0 * c["t"], 30.0 + 0 * c["t"]])[::5]
    events = [
        ("fast", [("gyro.x", "f"), ("gyro.y", "f"), ("gyro.z", "f")], stamps, gyro),
        (
            "slow",
            [("stabilizer.roll", "f"), ("stabilizer.pitch", "f"), ("stabilizer.yaw", "f")],
            stamps[::5],
            euler,
        ),
    ]
    path = tmp_path / "log01"
    content = bytearray(w.usd_bytes(events))
    path.write_bytes(content)
    raw = read_table(path)
    assert np.isfinite(raw.channels["qw"]).sum() == N / 5
    # Roll 10, nose up 20 (the firmware's sign), yaw 30 degrees: ZYX with pitch -20.
    half = np.deg2rad([5.0, -10.0, 15.0])
    (cr, cp, cy), (sr, sp, sy) = np.cos(half), np.sin(half)
    expected = [
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    ]
    np.testing.assert_allclose(
        [raw.channels[k][0] for k in ("qw", "qx", "qy", "qz")], expected, atol=1e-6
    )
    content[-1] ^= 1
    path.write_bytes(content)
    assert any("check sum is wrong" in n for n in read_table(path).notes)


def test_packed_rates_have_the_signs_of_the_gyro(tmp_path: Path) -> None:
    """stabilizer.c packs the pitch rate with the sign of its pitch: nose up."""
    c = w.channels(rows=N)
    names = [(f"stateEstimateZ.rate{n}", "h") for n in ("Roll", "Pitch", "Yaw")]
    packed = np.rint(1e3 * np.column_stack([c["p"], -c["q"], c["r"]]))
    path = tmp_path / "log02"
    path.write_bytes(w.usd_bytes([("packed", names, np.rint(c["t"] * 1e6), packed)]))
    raw = read_table(path)
    for name in "pqr":
        np.testing.assert_allclose(raw.channels[name], c[name], atol=1e-3)


# Tables -------------------------------------------------------------------------------------------------------------


def test_structs_and_matrices_of_matlab_are_columns(tmp_path: Path) -> None:
    from scipy.io import savemat

    t = 0.01 * np.arange(N)
    gyro = np.column_stack([t, 2 * t, 3 * t])
    content: dict[str, Any] = {
        "imu": {"time": t, "gyro": gyro.T},
        "motor": np.full((N, 4), 0.5),
        "gps": np.zeros(7),
        "name": "quad",
    }
    savemat(tmp_path / "f.mat", content)
    named = mapping(
        tmp_path,
        '[time]\nfield = "imu.time"\n[rate]\nfields = ["imu.gyro[0]", "imu.gyro[1]", '
        '"imu.gyro[2]"]\n'
        '[command]\nfields = ["motor[0]", "motor[1]", "motor[2]", "motor[3]"]\n',
    )
    raw = read_table(tmp_path / "f.mat", mapping=named)
    np.testing.assert_allclose(raw.channels["r"], 3 * t)
    (tmp_path / "new.mat").write_bytes(b"MATLAB 7.3 MAT-file, Platform: GLNXA64" + bytes(500))
    with pytest.raises(GreyboxError, match="'-v7'"):
        read_table(tmp_path / "new.mat")


def test_of_lengths_that_are_as_many_the_first_vectors_of_matlab_count(tmp_path: Path) -> None:
    from scipy.io import savemat

    for n, names in ((60, ["p", "q"]), (7, ["r", "s"])):
        first = {k: np.arange(float(n)) for k in names}
        savemat(tmp_path / "f.mat", first | {k: np.arange(30.0) for k in ("u", "v")})
        assert list(read_mat(tmp_path / "f.mat").columns) == names


def test_times_and_lists_of_parquet_are_columns(tmp_path: Path) -> None:
    pa = pytest.importorskip("pyarrow")
    import pyarrow.parquet as pq

    stamps = [1_700_000_000_000_000 + 10_000 * k for k in range(N)]
    table = pa.table(
        {
            "timestamp": pa.array(stamps, type=pa.timestamp("us")),
            "gyro": pa.array([[0.1, 0.2, 0.3]] * N, type=pa.list_(pa.float32())),
            "u1": pa.array([0.5, None] * (N // 2)),
            "mode": ["hover"] * N,
        }
    )
    pq.write_table(table, tmp_path / "f.parquet")
    named = mapping(tmp_path, '[rate]\nfields = ["gyro[0]", "gyro[1]", "gyro[2]"]\n')
    raw = read_table(tmp_path / "f.parquet", mapping=named)
    np.testing.assert_allclose(np.diff(raw.t), 0.01, atol=1e-6)
    pq.write_table(
        table.rename_columns(["timestamp_us", "gyro", "u1", "mode"]), tmp_path / "us.parquet"
    )
    np.testing.assert_array_equal(read_table(tmp_path / "us.parquet", mapping=named).t, raw.t)
    np.testing.assert_allclose(raw.channels["q"], 0.2, atol=1e-7)
    assert np.isnan(raw.channels["u1"]).sum() == N / 2


@pytest.mark.parametrize("write", [w.write_parquet, w.write_mat])
def test_columns_of_a_vehicle_file_name_those_of_any_table(write: Any, tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    path = flight_path("nanobench", "B2_circle_fast_rep1")
    columns = {k: v for k, v in read_csv(path).columns.items() if v.dtype.kind == "f"}
    known = read_table(path, w.vehicle())
    raw = read_table(
        write(tmp_path / ("f.mat" if write is w.write_mat else "f.parquet"), columns), w.vehicle()
    )
    assert list(raw.channels) == list(known.channels)
    assert raw.noncausal == known.noncausal == {"vx", "vy", "vz"}
    for name in known.channels:
        np.testing.assert_array_equal(raw.channels[name], known.channels[name])


def test_a_smoothed_channel_of_a_mapping_never_starts_a_prediction(tmp_path: Path) -> None:
    path = w.write_csv(tmp_path / "f.csv", w.own_columns(w.channels(rows=N)))
    named = mapping(
        tmp_path,
        '[time]\nfield = "time_ms"\n[rate]\nfields = ["gyr_x", "gyr_y", "gyr_z"]\ncausal = false\n',
    )
    assert read_table(path, mapping=named).noncausal == {"p", "q", "r"}
    left_out = mapping(
        tmp_path,
        '[rate]\nuse = false\n[time]\nfield = "time_ms"\n[command]\nfields = ["pwm1", "pwm2"]\n',
    )
    assert set(read_table(path, mapping=left_out).channels) == {"u1", "u2"}


def test_inspect_shows_a_log_of_another_number_of_rotors(tmp_path: Path) -> None:
    c = w.channels(rows=N)
    six = {**{k: c[k] for k in ("t", "p", "q", "r")}, **{f"u{i}": c["u1"] for i in range(1, 7)}}
    found = inspect_log(w.write_csv(tmp_path / "f.csv", six))
    assert found.groups[0].channels == ("u1", "u2", "u3", "u4", "u5", "u6")
