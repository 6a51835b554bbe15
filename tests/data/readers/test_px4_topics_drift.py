"""PX4 logs of different versions, settings and faults give the same channels."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from greybox.data.inspection import inspect_log
from greybox.data.logs import read_log, read_table
from greybox.data.readers import read_recording
from tests.data.readers import writers as w

pyulog = pytest.importorskip("pyulog")
N = 300


def with_change(
    path: Path, change: Callable[[w.ULogWriter, np.ndarray], Any], **options: Any
) -> Path:
    return w.write_ulog(path, w.channels(rows=N), change=change, **options)


def test_the_formats_own_writer_gives_the_same_log(tmp_path: Path) -> None:
    first = w.write_ulog(tmp_path / "a.ulg", w.channels(rows=N))
    pyulog.ULog(str(first)).write_ulog(str(tmp_path / "b.ulg"))
    one, two = read_table(first), read_table(tmp_path / "b.ulg")
    assert list(one.channels) == list(two.channels)
    np.testing.assert_array_equal(one.t, two.t)
    for name in one.channels:
        np.testing.assert_array_equal(one.channels[name], two.channels[name])


def test_rotors_of_the_log_are_those_of_the_vehicle(tmp_path: Path) -> None:
    found = read_recording(w.write_ulog(tmp_path / "a.ulg", w.channels(rows=N)))
    for (position, spin), rotor in zip(found.rotors, w.vehicle().rotors, strict=True):
        np.testing.assert_allclose(position, rotor.position, atol=1e-7)
        assert spin == rotor.spin


def test_without_sensor_combined_the_filtered_gyro_is_taken_at_its_sample_time(
    tmp_path: Path,
) -> None:
    c = w.channels(rows=N)

    def change(log: w.ULogWriter, stamps: np.ndarray) -> None:
        log.data.clear()
        gyro = np.column_stack(w.to_frd(c, ("p", "q", "r"))).astype(np.float32)
        sampled = stamps.astype(np.uint64)
        log.topic(
            "vehicle_angular_velocity", stamps + 1500, {"timestamp_sample": sampled, "xyz": gyro}
        )

    raw = read_table(with_change(tmp_path / "a.ulg", change))
    assert any("low-pass filtered by PX4" in n for n in raw.notes)
    np.testing.assert_allclose(raw.t, c["t"], atol=1e-6)
    np.testing.assert_allclose(raw.channels["q"], c["q"], atol=1e-5)


def test_integrated_gyro_belongs_to_the_middle_of_its_interval(tmp_path: Path) -> None:
    c = w.channels(rows=N)
    boot = 50.0

    def change(log: w.ULogWriter, stamps: np.ndarray) -> None:
        log.data = [
            (t, m) for t, m in log.data if m[3:5] != b"\0\0"
        ]  # message 0 is sensor_combined
        gyro = np.column_stack(w.to_frd(c, ("p", "q", "r")))
        span = np.full(N, 4000, np.uint32)
        fields = {"delta_angle": (gyro * 0.004).astype(np.float32), "delta_angle_dt": span}
        log.topic("vehicle_imu", stamps + 2000, fields)

    raw = read_table(with_change(tmp_path / "a.ulg", change, boot=boot))
    assert any("t = 0 is 50.000000 s" in n for n in raw.notes), raw.notes
    np.testing.assert_allclose(raw.channels["p"], c["p"], atol=1e-5)
    np.testing.assert_allclose(raw.channels["u1"], c["u1"], atol=1e-5)


@pytest.mark.parametrize("functions", [(101, 102, 103, 104), (104, 102, 101, 103)])
def test_outputs_are_put_into_motor_order_by_their_functions(
    tmp_path: Path, functions: tuple[int, ...]
) -> None:
    c = w.channels(rows=N)

    def change(log: w.ULogWriter, stamps: np.ndarray) -> None:
        log.data = [
            (t, m) for t, m in log.data if m[3:5] not in (b"\1\0", b"\2\0")
        ]  # both actuator_outputs
        pwm = np.full((N, 16), 900.0)
        for place, function in enumerate(functions):
            log.parameter(f"PWM_MAIN_FUNC{place + 1}", function)
            pwm[:, place] = 1100 + 800 * c[f"u{function - 100}"]
        log.parameter("PWM_MAIN_MIN1", 1100)
        log.parameter("PWM_MAIN_MAX1", 1900)
        fields = {"noutputs": np.full(N, 4, np.uint32), "output": pwm.astype(np.float32)}
        log.topic("actuator_outputs", stamps, fields, instance=2)

    raw = read_table(with_change(tmp_path / "a.ulg", change, version="old"))
    for i in (1, 2, 3, 4):
        np.testing.assert_allclose(raw.channels[f"u{i}"], c[f"u{i}"], atol=1e-5)


@pytest.mark.parametrize(
    "ranges",
    [
        # one range of all outputs; -1 in those of each stands for it (PX4 1.7 to 1.12)
        {"PWM_MIN": 1075, "PWM_MAX": 1950, "PWM_MAIN_MIN1": -1, "PWM_MAIN_MAX1": -1},
        {"PWM_MAIN_MIN": 1075, "PWM_MAIN_MAX": 1950, "PWM_MAIN_MIN1": -1, "PWM_MAIN_MAX1": -1},
        # motors on auxiliary outputs beside main ones of another range
        {"PWM_MAIN_MIN1": 1000, "PWM_MAIN_MAX1": 2000}
        | {f"PWM_AUX_FUNC{i}": 100 + i for i in (1, 2, 3, 4)}
        | {f"PWM_AUX_MIN{i}": 1075 for i in (1, 2, 3, 4)}
        | {f"PWM_AUX_MAX{i}": 1950 for i in (1, 2, 3, 4)},
    ],
)
def test_pulses_have_the_range_of_the_outputs_that_send_them(
    tmp_path: Path, ranges: dict[str, int]
) -> None:
    def change(log: w.ULogWriter, stamps: np.ndarray) -> None:
        log.parameter("PWM_MIN", -1)
        log.parameter("PWM_MAX", -1)
        for name, value in ranges.items():
            log.parameter(name, value)

    c = w.channels(rows=N)
    raw = read_table(with_change(tmp_path / "a.ulg", change, version="old"))
    for i in (1, 2, 3, 4):
        np.testing.assert_allclose(raw.channels[f"u{i}"], c[f"u{i}"], atol=1e-5)


def test_disarmed_outputs_are_zero_and_not_negative(tmp_path: Path) -> None:
    c = w.channels(rows=N)
    c["u1"][:50] = (900 - 1075) / (1950 - 1075)
    raw = read_table(w.write_ulog(tmp_path / "a.ulg", c, version="old"))
    assert (raw.channels["u1"][:50] == 0).all()


def motors_on(bus: str) -> dict[str, float]:
    return {f"{bus}_FUNC{i}": 100 + i for i in (1, 2, 3, 4)}


GAZEBO = {
    **motors_on("SIM_GZ_EC"),
    **{f"SIM_GZ_EC_MIN{i}": 150 for i in (1, 2, 3, 4)},
    **{f"SIM_GZ_EC_MAX{i}": 1000 for i in (1, 2, 3, 4)},
}


@pytest.mark.parametrize(
    ("parameters", "idle"),
    [
        ({"DSHOT_MIN": 0.055, **motors_on("PWM_MAIN")}, 0.0),
        ({"DSHOT_MIN": 0.055, "PWM_MAIN_TIM0": -1, **motors_on("PWM_MAIN")}, 0.0),
        ({"DSHOT_MIN": 0.055, "PWM_MAIN_TIM0": -4, **motors_on("PWM_MAIN")}, 0.055),
        ({"DSHOT_MIN": 0.07, "PWM_AUX_TIM1": -3, **motors_on("PWM_AUX")}, 0.07),
        # timers of outputs that drive no motor
        ({"DSHOT_MIN": 0.055, "PWM_AUX_TIM0": -5, **motors_on("UAVCAN_EC")}, 0.0),
        ({"DSHOT_MIN": 0.055, "PWM_AUX_TIM0": -5, **motors_on("PWM_MAIN")}, 0.0),
        (GAZEBO, 0.15),
    ],
)
def test_a_running_motor_that_is_commanded_nothing_idles(
    tmp_path: Path, parameters: dict[str, float], idle: float
) -> None:
    """Rotor speed over full speed is the command: of x500 in Gazebo 150 + 850 u of 1000 rad/s."""
    c = w.channels(rows=N)

    def change(log: w.ULogWriter, stamps: np.ndarray) -> None:
        for name, value in parameters.items():
            log.parameter(name, value)

    for i in (1, 2, 3, 4):
        c[f"u{i}"][:20] = 0.0  # all stopped
    c["u2"][30] = 0.0  # one at its least, in flight
    raw = read_table(w.write_ulog(tmp_path / "a.ulg", c, change=change))
    for i in (1, 2, 3, 4):
        flown = idle + (1 - idle) * c[f"u{i}"][20:]
        np.testing.assert_allclose(raw.channels[f"u{i}"][20:], flown, atol=1e-5)
        assert (raw.channels[f"u{i}"][:20] == 0).all()


@pytest.mark.parametrize("level", [0.6, 0.3])
def test_outputs_to_gazebo_are_the_commands_of_the_same_flight(
    tmp_path: Path, level: float
) -> None:
    """They are rotor speeds, of 150 + 850 u of 1000 rad/s those of actuator_motors."""
    c = w.channels(rows=N)
    sent = level + 0.3 * np.column_stack([c[f"u{i}"] for i in (1, 2, 3, 4)])
    sent[:20] = 0.0  # disarmed

    def change(log: w.ULogWriter, stamps: np.ndarray) -> None:
        log.data = [(t, m) for t, m in log.data if m[3:5] not in (b"\1\0", b"\2\0")]
        for name, value in GAZEBO.items():
            log.parameter(name, value)
        output = np.zeros((N, 16), np.float32)
        output[:, :4] = 1000 * sent
        fields = {"noutputs": np.full(N, 4, np.uint32), "output": output}
        log.topic("actuator_outputs", stamps, fields, instance=2)

    raw = read_table(with_change(tmp_path / "a.ulg", change, version="old"))
    for i in (1, 2, 3, 4):
        np.testing.assert_allclose(raw.channels[f"u{i}"], sent[:, i - 1], atol=1e-5)
    said = [n for n in raw.notes if "actuator_outputs" in n]
    assert any("speed 0..1000 rad/s" in n for n in said), said
    assert not any("PWM" in n for n in said)


def with_speeds(log: w.ULogWriter, stamps: np.ndarray) -> None:
    import struct

    log.definitions += log._message("F", b"esc_report:int32_t esc_rpm;uint8_t actuator_function;")
    log.definitions += log._message("F", b"esc_status:uint64_t timestamp;esc_report[4] esc;")
    log.subscriptions += log._message("A", b"\0" + log.count.to_bytes(2, "little") + b"esc_status")
    for stamp in stamps.astype(int):
        body = struct.pack("<HQ", log.count, stamp)
        for motor in (3, 1, 4, 2):
            body += struct.pack("<iB", -1000 * motor, 100 + motor)
        log.data.append((stamp, log._message("D", body)))
    log.count += 1


def test_what_gazebo_was_commanded_is_no_measured_speed(tmp_path: Path) -> None:
    """Its bridge publishes the commands [rad/s] as esc_rpm."""

    def change(log: w.ULogWriter, stamps: np.ndarray) -> None:
        with_speeds(log, stamps)
        for name, value in GAZEBO.items():
            log.parameter(name, value)

    assert "omega1" not in read_table(with_change(tmp_path / "a.ulg", change)).channels


def test_esc_speeds_follow_the_motor_that_they_drive(tmp_path: Path) -> None:
    raw = read_table(with_change(tmp_path / "a.ulg", with_speeds))
    for i in (1, 2, 3, 4):
        np.testing.assert_allclose(raw.channels[f"omega{i}"], 1000 * i * np.pi / 30, rtol=1e-6)


def test_motion_capture_is_offered_and_taken_where_the_mapping_says_so(tmp_path: Path) -> None:
    c = w.channels(rows=N)

    def change(log: w.ULogWriter, stamps: np.ndarray) -> None:
        place = np.column_stack(w.to_ned(c, ("x", "y", "z"))).astype(np.float32) + np.float32(5.0)
        log.topic(
            "vehicle_visual_odometry",
            stamps,
            {"position": place, "q": w.px4_attitude(c).astype(np.float32)},
        )

    path = with_change(tmp_path / "a.ulg", change)
    found = inspect_log(path)
    assert any(o.startswith("position: ") and "vehicle_visual_odometry" in o for o in found.others)
    np.testing.assert_allclose(read_table(path).channels["z"][::5], c["z"][::5], atol=1e-5)
    chosen = tmp_path / "map.toml"
    chosen.write_text(
        'schema = "greybox.mapping/1"\n[position]\nstream = "vehicle_visual_odometry"\n'
    )
    np.testing.assert_allclose(
        read_table(path, mapping=chosen).channels["z"], c["z"] - 5.0, atol=1e-5
    )


def test_drop_outs_become_breaks_and_are_reported(tmp_path: Path) -> None:
    def change(log: w.ULogWriter, stamps: np.ndarray) -> None:
        lost = (stamps[120], stamps[160])
        log.data = [(t, m) for t, m in log.data if not lost[0] <= t < lost[1]]
        log.dropout(int(lost[0]), 400)

    path = with_change(tmp_path / "a.ulg", change)
    found = inspect_log(path)
    assert found.recording.dropouts == ((pytest.approx(77.0 + 1.19), pytest.approx(0.4)),)
    flight = read_log(path, w.vehicle(), trim=False)
    assert [s.n for s in flight.segments] == [120, 140]
    assert any("lost data for 400 ms at t = 1.190 s" in n for n in flight.notes)


def test_commands_at_ten_hertz_are_called_too_slow(tmp_path: Path) -> None:
    """The default logging profile: the setting that helps is named."""

    def change(log: w.ULogWriter, stamps: np.ndarray) -> None:
        kept = set(stamps[::10].astype(int).tolist())
        log.data = [
            (t, m) for t, m in log.data if m[3:5] != b"\1\0" or t in kept
        ]  # message 1 is actuator_motors

    path = with_change(tmp_path / "a.ulg", change)
    found = inspect_log(path)
    slow = next(m for m in found.missing if m.group == "command")
    assert slow.reason.startswith("only 10 Hz")
    assert "SDLOG_PROFILE" in slow.advice
    assert any("logged at 10 Hz only" in n for n in found.notes)


def test_slow_topics_are_not_interpolated(tmp_path: Path) -> None:
    raw = read_table(w.write_ulog(tmp_path / "a.ulg", w.channels(rows=N), slow_every=10))
    known = np.isfinite(raw.channels["vx"])
    assert known.sum() == N / 10
    flight = read_log(tmp_path / "a.ulg", w.vehicle(), trim=False)
    assert np.isfinite(flight.segments[0].channels["vx"]).sum() == N / 10
