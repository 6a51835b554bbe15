"""Odd columns: the guess has the groups, order and units that the vehicle files of the shipped
flights state."""

from __future__ import annotations

import gzip
import json
import re
import shlex
import tomllib
from pathlib import Path

import numpy as np
import pytest

import greybox
from greybox.cli import main
from greybox.data.column_guess import Guess, draft, guess_columns, guess_time
from greybox.data.inspection import inspect_log
from greybox.data.logs import read_log
from greybox.examples import flight_path, vehicle_path
from greybox.model.vehicle import read_vehicle


@pytest.mark.parametrize(
    ("kind", "name"), [("arpl_crazyflie", "log16"), ("nanobench", "B2_circle_slow_rep1")]
)
def test_a_draft_reads_what_the_vehicle_file_reads(kind: str, name: str, tmp_path: Path) -> None:
    log, vehicle = flight_path(kind, name), read_vehicle(vehicle_path(kind))
    columns = inspect_log(log).recording.streams["table"].fields
    (tmp_path / "map.toml").write_text(draft(guess_columns(columns), guess_time(columns)))
    drafted, stated = read_log(log, mapping=tmp_path / "map.toml"), read_log(log, vehicle)
    compared = 0
    for channel in ("u1", "u4", "p", "q", "r", "ax", "az", "vbat", "qw", "qz", "x", "vz"):
        if channel in stated.channels:
            a, b = (
                np.concatenate([s.channels[channel] for s in f.segments]) for f in (drafted, stated)
            )
            tolerance = (
                5e-3 if channel.startswith("a") else 1e-4
            )  # g is 9.81 in one, 9.80665 in the other
            np.testing.assert_allclose(a[:500], b[:500], rtol=tolerance, atol=tolerance)
            compared += 1
    assert compared >= 7


@pytest.mark.parametrize(
    ("names", "values", "expected"),
    [
        (["gx", "gy", "gz"], [[300, -200, 50]], None),
        (["gyroADC[0]", "gyroADC[1]", "gyroADC[2]"], [[300, -200, 50]], ("rate", "deg/s", None)),
        (["imu.gyr_x", "imu.gyr_y", "imu.gyr_z"], [[3, -2, 0.5]], ("rate", "rad/s", None)),
        (["AccX", "AccY", "AccZ"], [[10, 20, 995]], ("specific_force", "mg", None)),
        (
            ["accSmooth[0]", "accSmooth[1]", "accSmooth[2]"],
            [[10, 20, 2048]],
            ("specific_force", "", None),
        ),
        (
            ["pwm1", "pwm2", "pwm3", "pwm4"],
            [[1200, 1000, 1900, 1500]],
            ("command", "", (1000, 2000)),
        ),
        (["cmd1", "cmd2", "cmd3", "cmd4"], [[0, 8, 3, 4]], ("command", "", None)),
        (["cmd1", "cmd2", "cmd3", "cmd4"], [[-1, 1, 0.3, 0.4]], ("command", "", None)),
        (["cmd1", "cmd2", "cmd3", "cmd4"], [[0, 838, 300, 400]], ("command", "", None)),
        (["esc_0", "esc_1", "esc_2", "esc_3"], [[0.2, 0.4, 0.9, 0.5]], ("command", "", None)),
        (
            ["rpm1", "rpm2", "rpm3", "rpm4"],
            [[9000, 9100, 8900, 12000]],
            ("rotor_speed", "rpm", None),
        ),
        (["att.roll", "att.pitch", "att.yaw"], [[10, -20, 170]], ("attitude", "deg", None)),
        (["VBAT"], [[15800]], ("battery", "mV", None)),
        (["batt_mV"], [[15800]], ("battery", "mV", None)),
        (
            ["gyro_roll_dps", "gyro_pitch_dps", "gyro_yaw_dps"],
            [[3, -2, 0.5]],
            ("rate", "deg/s", None),
        ),
        (
            ["gyro_x_rad_s", "gyro_y_rad_s", "gyro_z_rad_s"],
            [[30, -200, 50]],
            ("rate", "rad/s", None),
        ),
        (["acc_x_g", "acc_y_g", "acc_z_g"], [[0, 0.1, 1]], ("specific_force", "g", None)),
        (
            ["accx_m_s2", "accy_m_s2", "accz_m_s2"],
            [[0, 0.1, 9.8]],
            ("specific_force", "m/s^2", None),
        ),
        (["vel_x_mps", "vel_y_mps", "vel_z_mps"], [[300, 2, 1]], ("velocity", "m/s", None)),
        (
            ["act0", "act1", "act2", "act3"],
            [[1200, 1100, 1900, 1500]],
            ("command", "", (1000, 2000)),
        ),
        (
            [f"rotor{i} [%]" for i in (1, 2, 3, 4)],
            [[12, 11, 100, 15]],
            ("command", "", (0, 100)),
        ),
        (
            [f"rotor{i} (us)" for i in (1, 2, 3, 4)],
            [[1200, 1100, 1900, 1500]],
            ("command", "", (1000, 2000)),
        ),
        ([f"rotor_{i}" for i in range(4)], [[0.2, 0.4, 0.9, 0.5]], ("command", "", None)),
        ([f"rotor{i}" for i in (1, 2, 3, 4)], [[12, 11, 99, 15]], ("command", "", (0, 100))),
        (
            [f"cmd_rotor{i}" for i in range(4)],
            [[500, 800, 60000, 900]],
            ("command", "", (0, 65535)),
        ),
        ([f"rotor_{i}" for i in range(4)], [[500, 800, 1900, 900]], None),
        ([f"rotor{i}" for i in (1, 2, 3, 4)], [[9000, 9100, 21000, 12000]], None),
        ([f"rotor{i}" for i in (1, 2, 3, 4)], [[np.nan] * 4], None),
        ([f"rotor{i}_rpm" for i in (1, 2, 3, 4)], [[12, 11, 19, 15]], ("rotor_speed", "rpm", None)),
        (["phase_a", "phase_b", "phase_c"], [[1, 2, 3]], None),
        (["temp1", "temp2", "temp3"], [[20, 21, 22]], None),
        (
            [f"ESC {i} (RPM)" for i in (1, 2, 3, 4)],
            [[3000, 3100, 2900, 3050]],
            ("rotor_speed", "rpm", None),
        ),
        (
            [f"Motor {i} (Hz)" for i in (1, 2, 3, 4)],
            [[200, 210, 190, 205]],
            ("rotor_speed", "Hz", None),
        ),
        ([f"ESC {i} (A)" for i in (1, 2, 3, 4)], [[2, 3, 2, 3]], None),
        (
            ["rpm1", "rpm2", "rpm3", "rpm4"],
            [[1300, 3400, 1400, 3300]],
            ("rotor_speed", "rpm", None),
        ),
        (
            [f"target_rpm_{i}" for i in (1, 2, 3, 4)],
            [[1300, 3400, 1400, 3300]],
            ("command", "", None),
        ),
        ([f"action_rpm_{i}" for i in range(4)], [[1300, 1900, 1400, 1300]], ("command", "", None)),
        ([f"omega{i}_ref" for i in (1, 2, 3, 4)], [[130, 190, 140, 130]], ("command", "", None)),
        (["phi", "theta", "psi"], [[0.1, -0.2, 3.0]], ("attitude", "rad", None)),
        (["phi_dot", "theta_dot", "psi_dot"], [[0.1, -0.2, 3.0]], None),
        (["dphi", "dtheta", "dpsi"], [[0.1, -0.2, 3.0]], None),
        (["X_mm", "Y_mm", "Z_mm"], [[30, 20, 100]], ("position", "mm", None)),
        (["x_ref", "y_ref", "z_ref"], [[3, 2, 1]], ("setpoint", "m", None)),
        (["u", "v", "w"], [[3, 2, 1]], ("velocity", "m/s", None)),
        (["xdot", "ydot", "zdot"], [[3, 2, 1]], ("velocity", "m/s", None)),
        (["pos_x_dot", "pos_y_dot", "pos_z_dot"], [[3, 2, 1]], ("velocity", "m/s", None)),
        (["w0", "w1", "w2", "w3"], [[230, 240, 220, 235]], ("rotor_speed", "rad/s", None)),
        ([f"w_cmd{i}" for i in (1, 2, 3, 4)], [[230, 240, 220, 235]], ("command", "", None)),
        (["w0", "w1", "w2"], [[0.1, 0.2, 0.3]], ("rate", "rad/s", None)),
        ([f"control_{i}" for i in (1, 2, 3, 4)], [[0.2, 0.4, 0.9, 0.5]], ("command", "", None)),
        (
            [f"motor{i}_pwm" for i in (1, 2, 3, 4)],
            [[1200, 1000, 1900, 1500]],
            ("command", "", (1000, 2000)),
        ),
        (
            [f"esc{i}_rpm" for i in (1, 2, 3, 4)],
            [[9000, 9100, 8900, 12000]],
            ("rotor_speed", "rpm", None),
        ),
        ([f"motor{i}_temp" for i in (1, 2, 3, 4)], [[40, 41, 42, 40]], None),
        (["battery_temperature"], [[31]], None),
        (["gyro_temp_0", "gyro_temp_1", "gyro_temp_2"], [[31, 32, 30]], None),
        (["acc_bias_x", "acc_bias_y", "acc_bias_z"], [[0.1, 0.2, 0.0]], None),
        (["battery_soc"], [[90]], None),
        (["vel_setpoint_x", "vel_setpoint_y", "vel_setpoint_z"], [[1, 0, 0.2]], None),
        (["v_sp_x", "v_sp_y", "v_sp_z"], [[1, 0, 0.2]], None),
        (["att_sp_x", "att_sp_y", "att_sp_z"], [[0.1, 0, 0.2]], None),
        (["thrust_sp_x", "thrust_sp_y", "thrust_sp_z"], [[0, 0, 0.2]], None),
        (["target_vel_x", "target_vel_y", "target_vel_z"], [[1, 0, 0.2]], None),
        (["pos_sp_x", "pos_sp_y", "pos_sp_z"], [[1, 0, 0.2]], ("setpoint", "m", None)),
    ],
)
def test_names_and_sizes(
    names: list[str], values: list[list[float]], expected: tuple[str, str, object] | None
) -> None:
    rows = np.repeat(np.asarray(values, dtype=float), 50, axis=0)
    found = guess_columns({n: rows[:, j] for j, n in enumerate(names)})
    assert [(g.group, g.unit, g.limits) for g in found] == ([] if expected is None else [expected])
    assert all(g.fields == tuple(names) for g in found)


def test_a_simulators_short_names_are_told_by_what_stands_beside_them() -> None:
    """g is a gyro beside an accelerometer's a, four forces are of rotors, and north, east and down
    alone are a place."""
    columns = {n: np.full(50, v) for n, v in zip("NED", (1.0, 2.0, -3.0), strict=True)}
    columns |= {n: np.full(50, 0.1) for n in ("gx", "gy", "gz", "ax", "ay")}
    columns |= {"az": np.full(50, -9.8)} | {f"F{i}": np.full(50, 3.0 + i) for i in range(1, 5)}
    found = {g.group: (g.fields, g.frame) for g in guess_columns(columns)}
    assert found == {
        "command": (("F1", "F2", "F3", "F4"), ""),
        "specific_force": (("ax", "ay", "az"), "FRD"),
        "rate": (("gx", "gy", "gz"), "FRD"),
        "position": (("N", "E", "D"), "NED"),
    }


IN_WORDS = {
    "Time (ms)": 10.0 * np.arange(50),
    "Gyro X (deg/s)": 3.0,
    "Gyro Y (deg/s)": -2.0,
    "Gyro Z (deg/s)": 0.1,
    "Acc X (g)": 0.02,
    "Acc Y (g)": -0.01,
    "Acc Z (g)": -1.0,
    "Roll [deg]": 1.0,
    "Pitch [deg]": 2.0,
    "Yaw [deg]": 3.0,
    "North (m)": 1.0,
    "East (m)": 2.0,
    "Down (m)": -3.0,
    "Vel North (m/s)": 1.0,
    "Vel East (m/s)": 0.0,
    "Vel Down (m/s)": 0.5,
    "Motor 1 (us)": 1500.0,
    "Motor 2 (us)": 1510.0,
    "Motor 3 (us)": 1490.0,
    "Motor 4 (us)": 1505.0,
    "Battery (V)": 11.1,
}
"""Columns as a spreadsheet names them: units in brackets, z and down downwards; no size tells deg/s
from rad/s here."""


def test_units_in_names_count_before_sizes_and_a_negative_z_turns_the_frame() -> None:
    columns = {n: np.broadcast_to(np.asarray(v, dtype=float), 50) for n, v in IN_WORDS.items()}
    found = {g.group: (g.unit, g.frame) for g in guess_columns(columns)}
    assert found == {
        "command": ("", ""),
        "battery": ("V", ""),
        "attitude": ("deg", "FRD/NED"),
        "specific_force": ("g", "FRD"),
        "rate": ("deg/s", "FRD"),
        "velocity": ("m/s", "NED"),
        "position": ("m", "NED"),
    }
    assert guess_time(columns) == ("Time (ms)", "ms")
    weak = {**columns, "Acc Z (g)": columns["Acc Z (g)"] / 9.81}
    assert "not gravity" in next(g.why for g in guess_columns(weak) if g.group == "specific_force")


def test_the_battery_is_the_column_of_volts_wherever_it_stands_and_units_part_families() -> None:
    names = [
        "battery_temperature",
        "battery_voltage",
        *(f"ESC {i} ({u})" for u in ("A", "RPM") for i in range(1, 5)),
    ]
    found = {g.group: g.fields for g in guess_columns({n: np.full(50, 12.0) for n in names})}
    assert found == {"battery": ("battery_voltage",), "rotor_speed": tuple(names[-4:])}


@pytest.mark.parametrize("scalar", [0, 3])
def test_a_numbered_quaternion_begins_with_the_component_of_a_level_craft(scalar: int) -> None:
    yaw = np.linspace(-3, 3, 90)
    level = {"w": np.cos(yaw / 2), "x": 0.1 + 0 * yaw, "y": -0.1 + 0 * yaw, "z": np.sin(yaw / 2)}
    order = "wxyz" if scalar == 0 else "xyzw"
    (guess,) = guess_columns({f"q[{i}]": level[part] for i, part in enumerate(order)})
    assert guess.group == "attitude"
    assert [order[int(name[2])] for name in guess.fields] == list("wxyz")


@pytest.mark.parametrize("four", [("q0", "q1", "q2", "q3"), ("qw", "qx", "qy", "qz")])
def test_a_quaternion_is_taken_before_angles(four: tuple[str, ...]) -> None:
    """Simulators call yaw psi, or roll; a quaternion is the same everywhere."""
    angles = {n: np.zeros(50) for n in ("psi", "theta", "phi")}
    level = dict(zip(four, (np.ones(50), *(np.zeros(50) for _ in range(3))), strict=True))
    (guess,) = guess_columns({**angles, **level})
    assert (guess.group, guess.fields) == ("attitude", four)


def test_velocities_u_v_w_are_those_of_the_body_in_the_frame_of_the_imu() -> None:
    log = {n: np.full(50, 1.0) for n in ("u", "v", "w", "acc_x", "acc_y")}
    for down, frame in ((9.8, "FLU"), (-9.8, "FRD")):
        found = guess_columns({**log, "acc_z": np.full(50, down)})
        assert {g.group: g.frame for g in found}["velocity"] == frame


def test_velocities_u_v_w_beside_a_place_that_counts_downwards_have_z_down() -> None:
    names = ("pn", "pe", "pd", "u", "v", "w")
    found = {g.group: g for g in guess_columns({n: np.ones(50) for n in names})}
    assert (found["position"].frame, found["velocity"].frame) == ("NED", "FRD")
    (alone,) = guess_columns({n: np.ones(50) for n in "uvw"})
    assert alone.frame == "FLU" and "nothing says down" in alone.why


@pytest.mark.parametrize("unit", ["", "[SI]"])
def test_a_letter_of_the_textbooks_is_one_thing_by_what_stands_beside_it(unit: str) -> None:
    """Of x, y, z, u, v, w a quaternion was made of w and the place, and the angles were passed."""
    names = ["x", "y", "z", "u", "v", "w", "p", "q", "r", "phi", "theta", "psi"]
    found = {g.group: g.fields for g in guess_columns({n + unit: np.ones(50) for n in names})}
    assert found["attitude"] == tuple(n + unit for n in ("phi", "theta", "psi"))
    assert found["velocity"] == tuple(n + unit for n in "uvw")
    assert found["position"] == tuple(n + unit for n in "xyz")
    (turn,) = guess_columns({n: np.ones(50) for n in "wxyz"})
    assert (turn.group, turn.fields) == ("attitude", tuple("wxyz"))


def test_a_numbered_quaternion_of_no_numbers_is_guessed_in_silence(
    recwarn: pytest.WarningsRecorder,
) -> None:
    (guess,) = guess_columns({f"q{i}": np.full(50, np.nan) for i in range(4)})
    assert guess.fields == ("q0", "q1", "q2", "q3") and "no numbers" in guess.why
    assert not recwarn.list


def test_a_draft_without_commands_says_what_is_to_be_filled_in(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    rows = [f"{0.005 * i:.3f},.1,.2,.3,400,410,420,430" for i in range(60)]
    Path("log.csv").write_text("\n".join(["t,gyro_x,gyro_y,gyro_z,fa,fb,fc,fd", *rows]))
    main(["inspect", "log.csv", "--draft", "map.toml"])
    assert "no columns look like commands: fill in [command], look map.toml over" in (
        capsys.readouterr().out
    )
    filled = re.sub(
        r"^# (\[command\]|fields|limits)", r"\1", Path("map.toml").read_text(), flags=re.M
    )
    filled = re.sub(r'"NAME OF.*"\]', '"fa", "fb", "fc", "fd"]', filled).replace("2000]", "0]")
    Path("map.toml").write_text(filled.replace("[1000, 0]", "[0, 1000]"))
    raw = inspect_log("log.csv", mapping="map.toml").raw
    assert raw is not None and raw.channels["u1"][0] == 0.4


def test_a_draft_is_toml_whatever_the_names_hold() -> None:
    names = tuple(f'\N{HELICOPTER} "gyro"\\\x7f\t.{a}' for a in "xyz")
    guesses = guess_columns({n: np.full(50, 0.1) for n in names})
    read = tomllib.loads(draft(guesses, (names[0], "s")))
    assert (tuple(read["rate"]["fields"]), read["time"]["field"]) == (names, names[0])


@pytest.mark.parametrize(("step", "unit"), [(0.002, "s"), (4.0, "ms"), (1000.0, "us"), (2e6, "ns")])
def test_the_clock_is_told_by_its_steps(step: float, unit: str) -> None:
    columns = {"loop": np.arange(50.0), "time": step * np.arange(50.0), "t2": np.zeros(50)}
    assert guess_time(columns) == ("time", unit)


@pytest.mark.parametrize(
    ("name", "step", "unit"),
    [
        ("usec", 5000, "us"),
        ("micros", 5000, "us"),
        ("timestamp_us", 5000, "us"),
        ("TimeUS", 100_000, "us"),  # 10 Hz, which the name alone tells from nanoseconds
        ("t_ms", 5, "ms"),
        ("millis", 1000, "ms"),
        ("time_boot_ms", 20, "ms"),
        ("Time (ms)", 500, "ms"),
        ("seconds", 0.01, "s"),
        ("timestamps", 10_000, "us"),
        ("t_us", 0.01, "s"),  # the name is wrong
        ("%time", 1e7, "ns"),
        ("field.header.stamp", 1e7, "ns"),
        ("Time since start (s)", 0.01, "s"),
        ("sim.t", 0.01, "s"),
        ("t_sim", 0.01, "s"),
    ],
)
def test_the_clock_is_told_by_its_name_then_by_its_steps(name: str, step: float, unit: str) -> None:
    columns = {"usage": np.zeros(50), name: 83e6 + step * np.arange(50.0)}
    assert guess_time(columns) == (name, unit)


@pytest.mark.parametrize(
    ("names", "group"),
    [
        (("vn", "ve", "vd"), "velocity"),
        (("VelN", "VelE", "VelD"), "velocity"),
        (("PN", "PE", "PD"), "position"),
        (("pos_n", "pos_e", "pos_d"), "position"),
    ],
)
def test_north_east_down_may_be_said_by_letters(names: tuple[str, ...], group: str) -> None:
    others = ("mode", "speed", "done", "id", "throttle")
    (guess,) = guess_columns({n: np.linspace(-1, 1, 50) for n in (*others, *names)})
    assert (guess.group, guess.fields, guess.frame) == (group, names, "NED")


def test_a_draft_without_a_clock_says_what_is_to_be_filled_in(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    rows = [
        f"{83e6 + 5000 * i:.0f}," + ",".join(f"{1500 + i}" for _ in range(4)) for i in range(60)
    ]
    for clock, told in (("usec", True), ("alpha", False)):
        Path("log.csv").write_text("\n".join([f"{clock},esc1,esc2,esc3,esc4", *rows]))
        main(["inspect", "log.csv", "--draft", "map.toml", "--force"])
        said = capsys.readouterr().out
        assert ("fill in [time]" in said) is not told
        assert ("  time: usec, us  (" in said) is told
        text = Path("map.toml").read_text()
        assert ('# field = "NAME OF THE COLUMN"' in text) is not told
        filled = re.sub(r"^# (\[time\]|field|unit)", r"\1", text, flags=re.M)
        Path("map.toml").write_text(filled.replace("NAME OF THE COLUMN", clock))
        assert inspect_log("log.csv", mapping="map.toml").raw is not None


def test_a_stranger_is_told_what_to_do(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("log.csv.gz").write_bytes(flight_path("arpl_crazyflie", "log16").read_bytes())
    assert main(["inspect", "log.csv.gz"]) == 1
    said = capsys.readouterr().out
    assert "nothing under these names" in said
    assert "inspect log.csv.gz --draft map.toml" in said
    assert "vehicle new --template" in said
    assert main(["inspect", "log.csv.gz", "--draft", "map.toml"]) == 1
    Path("map.toml").write_text(edited := Path("map.toml").read_text() + "# looked over\n")
    capsys.readouterr()
    assert main(["inspect", "log.csv.gz", "--draft", "map.toml"]) == 2
    assert "map.toml: the file exists" in (refused := capsys.readouterr().err)
    assert (refused.count("\n"), Path("map.toml").read_text()) == (1, edited)
    assert main(["inspect", "log.csv.gz", "--draft", "map.toml", "--force"]) == 1
    assert "looked over" not in Path("map.toml").read_text()
    assert main(["inspect", "log.csv.gz", "--mapping", "map.toml"]) == 0
    assert "greybox check --mapping map.toml --vehicle V.toml log.csv.gz" in capsys.readouterr().out
    Path("mine.toml").write_text(vehicle_path("arpl_crazyflie").read_text())
    main(["inspect", "log.csv.gz"])
    assert (
        "mine.toml knows these columns: greybox inspect log.csv.gz --vehicle mine.toml"
        in capsys.readouterr().out
    )
    assert main(["inspect", "log.csv.gz", "--vehicle", "mine.toml"]) == 0
    assert "greybox fit --vehicle mine.toml --train log.csv.gz" in capsys.readouterr().out


def test_the_frame_of_a_guess_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    columns = {n: np.broadcast_to(np.asarray(v, dtype=float), 50) for n, v in IN_WORDS.items()}
    rows = "\n".join(",".join(str(c[i]) for c in columns.values()) for i in range(50))
    (tmp_path / "log.csv").write_text(",".join(columns) + "\n" + rows)
    main(["inspect", str(tmp_path / "log.csv"), "--json", str(tmp_path / "found.json")])
    assert "Gyro Z (deg/s), deg/s, FRD  (" in capsys.readouterr().out
    content = json.loads((tmp_path / "found.json").read_text())
    assert {g["group"]: g["frame"] for g in content["looks_like"]}["position"] == "NED"
    schema = json.loads((Path(greybox.__file__).parent / "schemas/inspect.json").read_text())
    assert set(content["looks_like"][0]) == set(
        schema["properties"]["looks_like"]["items"]["required"]
    )


def test_the_way_on_can_be_typed_for_a_file_from_windows(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A byte order mark, CRLF, a blank and letters beyond ASCII in the name: what is printed runs
    as it is printed."""
    monkeypatch.chdir(tmp_path)
    text = gzip.decompress(flight_path("arpl_crazyflie", "log16").read_bytes()).decode()
    lines = text.splitlines()[:4000]
    Path("mein Flug ä.csv").write_bytes("\r\n".join(lines).encode("utf-8-sig"))
    assert main(["inspect", "mein Flug ä.csv"]) == 1
    for wanted in ("--draft", "--mapping"):
        typed = re.findall(rf"greybox (inspect .*{wanted} \S+)", capsys.readouterr().out)
        assert main(shlex.split(typed[0])) == (1 if wanted == "--draft" else 0)
    assert "usable" in capsys.readouterr().out


@pytest.mark.parametrize(("written", "scale"), [(2100.0, 100 / 7), (210_000.0, 1 / 7)])
def test_electrical_turns_are_divided_by_pole_pairs_that_are_said(
    written: float, scale: float, tmp_path: Path
) -> None:
    """30 000 turns a minute of a motor with 14 poles, as Betaflight writes them and as an ESC says
    them."""
    columns = {"t": 0.01 * np.arange(50)} | {f"eRPM[{i}]": np.full(50, written) for i in range(4)}
    (guess,) = guess_columns(columns)
    assert (guess.group, guess.unit, guess.scale) == ("rotor_speed", "rpm", pytest.approx(scale))
    assert "14 poles" in guess.why
    log = tmp_path / "f.csv"
    log.write_text(
        "\n".join(
            [
                ",".join(columns),
                *(",".join(map(str, r)) for r in zip(*columns.values(), strict=True)),
            ]
        )
    )
    (tmp_path / "map.toml").write_text(draft((guess,), ("t", "s")))
    speeds = read_log(log, mapping=tmp_path / "map.toml", trim=False).segments[0].channels["omega1"]
    np.testing.assert_allclose(speeds, 30_000 * np.pi / 30)


ROS = {
    "rate": "/imu/data/angular_velocity/{xyz}",
    "specific_force": "/imu/data/linear_acceleration/{xyz}",
    "position": "/odom/pose/pose/position/{xyz}",
    "velocity": "/odom/twist/twist/linear/{xyz}",
    "attitude": "/odom/pose/pose/orientation/{wxyz}",
    "rotor_speed": "/motor_speed/angular_velocities[{0123}]",
    "command": "/mavros/rc/out/channels[{0123}]",
}
PX4 = {
    "rate": "vehicle_angular_velocity/xyz.0{012}",
    "specific_force": "vehicle_acceleration/xyz.0{012}",
    "position": "vehicle_local_position/{xyz}",
    "velocity": "vehicle_local_position/v{xyz}",
    "attitude": "vehicle_attitude/q.0{0123}",
    "command": "actuator_motors/control.0{0123}",
}


@pytest.mark.parametrize("paths", [ROS, PX4], ids=["ROS", "PX4"])
def test_paths_of_messages_are_told_by_their_last_words(paths: dict[str, str]) -> None:
    names = {
        group: tuple(path[: path.index("{")] + end + path[path.index("}") + 1 :] for end in ends)
        for group, path in paths.items()
        for ends in (path[path.index("{") + 1 : path.index("}")],)
    }
    noise = np.random.default_rng(0)
    columns = {n: noise.normal(size=50) for members in names.values() for n in members}
    columns |= {f"/cmd_vel/twist/linear/{a}": noise.normal(size=50) for a in "xyz"}
    columns |= {f"cmd/{a}": noise.normal(size=50) for a in ("roll", "pitch", "yaw")}
    columns |= {names["attitude"][0]: np.ones(50)}
    columns |= {n: np.linspace(0.3, 0.7, 50) for n in names["command"]}  # of motors
    guesses = {g.group: g for g in guess_columns(columns)}
    assert {group: g.fields for group, g in guesses.items()} == names
    assert guesses["velocity"].frame == ("FLU" if paths is ROS else "")


def test_what_is_asked_for_is_nothing_measured() -> None:
    asked = ("cmd_vel_x", "cmd_vel_y", "cmd_vel_z", "cmd.roll", "cmd.pitch", "cmd.yaw")
    assert guess_columns({n: np.linspace(-1, 1, 50) for n in asked}) == ()


@pytest.mark.parametrize(("top", "said"), [(1.0, False), (700.0, True)])
def test_commands_without_a_range_are_said_to_need_one(
    top: float, said: bool, tmp_path: Path
) -> None:
    """Commanded speeds as a simulator logs them: usable, once their range is known."""
    t, rng = 0.01 * np.arange(400), np.random.default_rng(0)
    rows = [",".join(["t", "u1", "u2", "u3", "u4", "p", "q", "r"])]
    rows += [
        ",".join(f"{v:.6g}" for v in (k, *(top * rng.uniform(0.3, 0.8, 4)), *rng.normal(size=3)))
        for k in t
    ]
    (tmp_path / "a.csv").write_text("\n".join(rows) + "\n")
    verdict = inspect_log(tmp_path / "a.csv").verdict
    assert verdict.startswith("usable for a fit")
    assert ("say what is u = 0 and u = 1" in verdict) == said


@pytest.mark.parametrize(
    ("stem", "group"), [("w", "rate"), ("pos_", "position"), ("acc_", "specific_force")]
)
def test_numbers_beside_axes_take_nothing_from_them(stem: str, group: str) -> None:
    axes = tuple(f"{stem}{a}" for a in "xyz")
    columns = {n: np.linspace(-1.0, 1.0, 50) for n in axes}
    columns |= {f"{stem}{i}": np.linspace(400.0, 500.0, 50) for i in range(1, 5)}
    guesses = {g.group: g.fields for g in guess_columns(columns)}
    assert guesses[group] == axes


@pytest.mark.parametrize(
    "stem", ["actuator_controls_0.control", "torque_ctrl", "rates_control", "nn_w"]
)
def test_what_has_a_sign_drives_no_rotor(stem: str) -> None:
    signed = {f"{stem}[{i}]": np.linspace(-1.0, 1.0, 50) for i in range(4)}
    assert guess_columns(signed) == ()


def guessed(values: dict[str, object]) -> dict[str, Guess]:
    columns = {n: np.broadcast_to(np.asarray(v, dtype=float), 50) for n, v in values.items()}
    return {g.group: g for g in guess_columns(columns)}


def axes(stem: str, value: object, ends: str = "xyz", after: str = "") -> dict[str, object]:
    return {f"{stem}{end}{after}": value for end in ends}


SWING = np.linspace(-1.0, 1.0, 50)
SPEEDS = np.linspace(800.0, 1500.0, 50)
LEVEL = np.linspace(9.0, 11.0, 50)


def test_an_acceleration_of_the_angle_is_no_specific_force() -> None:
    """Columns of NeuroBEM, whose first is "ang acc x"."""
    found = guessed(axes("ang acc ", SWING) | axes("ang vel ", SWING) | axes("acc ", LEVEL))
    assert found["specific_force"].fields == ("acc x", "acc y", "acc z")
    assert found["rate"].fields == ("ang vel x", "ang vel y", "ang vel z")
    assert guessed(axes("ang acc ", SWING)) == {}


def test_what_is_measured_and_asked_of_each_rotor_is_its_speed() -> None:
    for stem, asked, after in (("mot_", "motdes_", ""), ("r", "r", "des")):
        found = guessed(axes(asked, SPEEDS, "1234", after) | axes(stem, SPEEDS, "1234"))
        assert found["rotor_speed"].fields == tuple(f"{stem}{i}" for i in "1234")
        assert found["command"].fields == tuple(f"{asked}{i}{after}" for i in "1234")
        assert found["command"].limits is None and "add limits" in found["command"].why


def test_what_goes_to_a_rotor_twice_is_no_speed() -> None:
    pulses = axes("pwm_ref", SPEEDS + 300.0, "1234") | axes("pwm", SPEEDS + 300.0, "1234")
    assert set(guessed(pulses)) == {"command"}
    shares = axes("motor_des", SPEEDS / 2e3, "1234") | axes("motor", SPEEDS / 2e3, "1234")
    assert set(guessed(shares)) == {"command"}


def test_a_thrust_of_each_rotor_is_a_command_in_a_range_of_its_own() -> None:
    share = guessed(axes("thrust[", np.linspace(0.2, 0.8, 50), "0123", "]"))
    assert "command" in share
    newtons = guessed(axes("thrust[", np.linspace(0.5, 3.0, 50), "0123", "]"))
    assert newtons["command"].limits is None and "add limits" in newtons["command"].why
    assert guessed(axes("thrust[", np.linspace(-1.0, 1.0, 50), "0123", "]")) == {}


def test_letters_of_axes_stand_behind_what_is_along_them() -> None:
    """Columns of EuRoC, a bias first; velocities of the body and accelerations of the world."""
    names = axes("b_a_RS_S_", 0.1, after=" [m s^-2]") | axes("w_RS_S_", SWING, after=" [rad s^-1]")
    names |= axes("a_RS_S_", LEVEL, after=" [m s^-2]") | axes("q_RS_", 0.5, "wxyz", " []")
    found = guessed(names | axes("p_RS_R_", SWING, after=" [m]"))
    assert set(found) == {"specific_force", "rate", "position", "attitude"}
    assert found["specific_force"].fields[0] == "a_RS_S_x [m s^-2]"
    assert (found["rate"].unit, found["specific_force"].unit) == ("rad/s", "m/s^2")
    found = guessed(axes("vel_body_", SWING) | axes("omega_world_", SWING))
    assert (found["velocity"].frame, found["rate"].frame) == ("FLU", "ENU")


def test_a_place_is_that_of_the_craft_and_sticks_turn_nothing() -> None:
    """Columns of a race of drones, and of a Crazyflie's log."""
    sticks = {f"channels_{c}": 1500 + 400 * SWING for c in ("roll", "pitch", "yaw")}
    found = guessed(axes("drone_", SWING) | axes("gate1_int_", 2.0) | sticks)
    assert set(found) == {"position"} and found["position"].fields[0] == "drone_x"
    names = axes("stateEstimate.", SWING) | axes("stateEstimate.q", 0.5, "wxyz")
    found = guessed(names | {f"stabilizer.{c}": SWING for c in ("roll", "pitch", "yaw")})
    assert found["attitude"].fields[0] == "stateEstimate.qw"
    assert found["position"].fields[0] == "stateEstimate.x"


@pytest.mark.parametrize("ends", [[f"{i}{j}" for i in "123" for j in "123"], list("012345678")])
def test_nine_numbers_that_turn_are_an_attitude(ends: list[str]) -> None:
    c, s, zero = np.cos(SWING), np.sin(SWING), np.zeros(50)
    turning = (c, -s, zero, s, c, zero, zero, zero, zero + 1.0)
    names = [f"rot{e}" for e in ends]
    (guess,) = guess_columns(dict(zip(names, turning, strict=True)))
    assert (guess.group, guess.fields) == ("attitude", tuple(names))
    assert guess_columns(dict(zip(names, (*turning[:8], 2.0 + zero), strict=True))) == ()
    still = dict(zip(names, np.repeat(np.eye(3).reshape(9, 1), 50, axis=1), strict=True))
    assert guess_columns(still) == ()


def test_an_acceleration_without_gravity_is_drafted_as_one(tmp_path: Path) -> None:
    columns = {f"acc_{a}": np.roll(3.0 * SWING, 12 * i) for i, a in enumerate("xyz")}
    (guess,) = guess_columns(columns)
    assert not guess.gravity and "gravity was taken out" in guess.why
    said = tomllib.loads(draft((guess,), ("t", "s")))
    assert said["specific_force"]["gravity"] is False


def test_the_columns_of_a_table_of_tables_are_names_and_no_units() -> None:
    """pandas flattens ("imu", "ax") into one text."""
    names = {f"('imu', 'a{a}')": LEVEL for a in "xyz"} | {f"('cmd', 'm{i}')": 0.5 for i in "1234"}
    assert set(guessed(names)) == {"specific_force", "command"}
    assert guess_time({"('time', 't')": 0.01 * np.arange(50.0)}) == ("('time', 't')", "s")


def test_the_part_of_a_second_is_no_clock() -> None:
    parts = np.round((0.01 * np.arange(500.0)) % 1.0 * 1e9)
    assert guess_time({"header.stamp.nsecs": parts}) is None


@pytest.mark.parametrize("stem", ["", "imu.", "('imu', '"])
def test_g_beside_a_is_the_gyro(stem: str) -> None:
    """gx, gy, gz alone may be the direction of gravity."""
    end = "')" if stem.startswith("(") else ""
    rates = axes(f"{stem}g", SWING, after=end)
    assert guessed(rates) == {}
    assert guessed(rates | axes(f"{stem}a", LEVEL, after=end))["rate"].fields == tuple(rates)


def test_a_letter_behind_the_word_of_a_sensor_is_of_axes_and_behind_another_word_the_sensor() -> (
    None
):
    """vel_w is a velocity along the world, drone_w the rate of the craft, in axes that no name
    tells."""
    found = guessed(axes("vel_w_", SWING) | axes("drone_w_", SWING))
    assert found["velocity"].fields[0] == "vel_w_x" and not found["velocity"].frame
    assert found["rate"].fields[0] == "drone_w_x" and not found["rate"].frame


def test_axes_in_a_name_are_its_frame() -> None:
    found = guessed(axes("vel_ned_", SWING) | axes("pos_ned_", SWING) | axes("gyr_frd_", SWING))
    frames = {group: found[group].frame for group in ("velocity", "position", "rate")}
    assert frames == {"velocity": "NED", "position": "NED", "rate": "FRD"}
