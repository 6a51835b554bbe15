"""One real flight written in the formats of the readers, byte for byte as each format's own
description has it.

The flight is a NanoBench one (Crazyflie, 100 Hz). Values are turned into each system's units, axes
and scales here, by formulas written independently of the readers: PX4 in FRD and NED, Betaflight in
counts, the Crazyflie in degrees and g.
"""

from __future__ import annotations

import functools
import struct
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from greybox.data.logs import read_table
from greybox.data.raw import RawLog
from greybox.examples import flight_path, vehicle_path
from greybox.model.vehicle import Vehicle, read_vehicle

ROWS = 1500
GRAVITY = 9.80665
Columns = Mapping[str, np.ndarray]


@functools.cache
def vehicle() -> Vehicle:
    return read_vehicle(vehicle_path("nanobench"))


@functools.cache
def flight() -> RawLog:
    return read_table(flight_path("nanobench", "B5_helix_medium_rep2"), vehicle())


def channels(start: int = 400, rows: int = ROWS) -> dict[str, np.ndarray]:
    """The middle of the flight, `t` from zero, on a clean 100 Hz clock."""
    raw = flight()
    out = {k: np.array(v[start : start + rows]) for k, v in raw.channels.items()}
    return {"t": 0.01 * np.arange(rows), **out}


def to_ned(c: Columns, names: Sequence[str]) -> list[np.ndarray]:
    """East, north, up to north, east, down."""
    return [c[names[1]], c[names[0]], -c[names[2]]]


def to_frd(c: Columns, names: Sequence[str]) -> list[np.ndarray]:
    """Forward, left, up to forward, right, down."""
    return [c[names[0]], -c[names[1]], -c[names[2]]]


def rotation(q: np.ndarray) -> np.ndarray:
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion(r: np.ndarray) -> np.ndarray:
    """Of a rotation matrix: the eigenvector of the largest eigenvalue of Bar-Itzhack's matrix."""
    k = np.array(
        [
            [r[0, 0] - r[1, 1] - r[2, 2], 0, 0, 0],
            [r[1, 0] + r[0, 1], r[1, 1] - r[0, 0] - r[2, 2], 0, 0],
            [r[2, 0] + r[0, 2], r[2, 1] + r[1, 2], r[2, 2] - r[0, 0] - r[1, 1], 0],
            [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], r[0, 0] + r[1, 1] + r[2, 2]],
        ]
    )
    values, vectors = np.linalg.eigh((k + np.tril(k, -1).T) / 3)
    x, y, z, w = vectors[:, np.argmax(values)]
    return np.array([w, x, y, z])


def px4_attitude(c: Columns) -> np.ndarray:
    """Body FRD to world NED, (N, 4), by matrices."""
    earth = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1.0]])
    body = np.diag([1, -1, -1.0])
    out = []
    for q in np.column_stack([c[k] for k in ("qw", "qx", "qy", "qz")]):
        out.append(
            quaternion(earth @ rotation(q / np.linalg.norm(q)) @ body)
            if np.isfinite(q).all()
            else q
        )
    return np.array(out)


# PX4 ULog -----------------------------------------------------------------------------------------------------------


class ULogWriter:
    """Bytes of a ULog file (docs.px4.io, "ULog File Format")."""

    TYPES: ClassVar = {
        "uint64_t": "Q",
        "float": "f",
        "uint32_t": "I",
        "uint8_t": "B",
        "int32_t": "i",
    }

    def __init__(self, start: int = 0) -> None:
        self.head = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", start)
        self.head += self._message("B", bytes(40))
        self.formats: dict[str, str] = {}
        self.definitions = b""
        self.data: list[tuple[int, bytes]] = []
        self.subscriptions = b""
        self.count = 0

    @staticmethod
    def _message(kind: str, content: bytes) -> bytes:
        return struct.pack("<HB", len(content), ord(kind)) + content

    def info(self, key: str, value: str) -> None:
        name = f"char[{len(value)}] {key}".encode()
        self.definitions += self._message("I", bytes([len(name)]) + name + value.encode())

    def parameter(self, key: str, value: float) -> None:
        kind = "int32_t" if isinstance(value, int) else "float"
        name = f"{kind} {key}".encode()
        content = bytes([len(name)]) + name + struct.pack("<" + self.TYPES[kind], value)
        self.definitions += self._message("P", content)

    def topic(
        self, name: str, stamps: np.ndarray, fields: Mapping[str, Any], instance: int = 0
    ) -> None:
        """A topic: stamps [us]; field "name" (N,) or "name[k]" (N, k), float unless integer."""
        members, layout, columns = ["uint64_t timestamp"], "<Q", []
        for key, values in fields.items():
            values = np.asarray(values)
            kind = (
                "float"
                if values.dtype.kind == "f"
                else ("uint8_t" if values.dtype == np.uint8 else "uint32_t")
            )
            kind = "uint64_t" if values.dtype == np.uint64 else kind
            wide = values.reshape(len(values), -1)
            plain = key.partition("[")[0]
            members.append(
                f"{kind}[{wide.shape[1]}] {plain}" if values.ndim == 2 else f"{kind} {plain}"
            )
            layout += self.TYPES[kind] * wide.shape[1]
            columns += list(wide.T)
        text = f"{name}:" + ";".join(members) + ";"
        if self.formats.setdefault(name, text) is text:
            self.definitions += self._message("F", text.encode())
        number = self.count
        self.count += 1
        self.subscriptions += self._message(
            "A", struct.pack("<BH", instance, number) + name.encode()
        )
        packer = struct.Struct(layout)
        for i, stamp in enumerate(stamps.astype(np.uint64)):
            row = [c[i].item() for c in columns]
            self.data.append(
                (
                    int(stamp),
                    self._message("D", struct.pack("<H", number) + packer.pack(int(stamp), *row)),
                )
            )

    def dropout(self, stamp: int, milliseconds: int) -> None:
        self.data.append((stamp, self._message("O", struct.pack("<H", milliseconds))))

    def bytes(self) -> bytes:
        body = b"".join(m for _, m in sorted(self.data, key=lambda pair: pair[0]))
        return self.head + self.definitions + self.subscriptions + body


def write_ulog(
    path: Path,
    c: Columns,
    *,
    version: str = "new",
    boot: float = 77.0,
    pose_every: int = 1,
    slow_every: int = 5,
    thrust_factor: float = 0.0,
    change: Any = None,
) -> Path:
    """A PX4 log of the flight: `new` as since 1.13 (actuator_motors), `old` as before
    (actuator_outputs in PWM)."""
    log = ULogWriter(start=int(boot * 1e6))
    log.info("sys_name", "PX4")
    log.info("ver_hw", "PX4_FMU_V5")
    stamps = np.rint((c["t"] + boot) * 1e6)
    gyro = np.column_stack(to_frd(c, ("p", "q", "r"))).astype(np.float32)
    force = np.column_stack(to_frd(c, ("ax", "ay", "az"))).astype(np.float32)
    n = len(stamps)
    log.topic(
        "sensor_combined",
        stamps,
        {
            "gyro_rad": gyro,
            "gyro_integral_dt": np.zeros(n, np.uint32),
            "accelerometer_m_s2": force,
            "accelerometer_integral_dt": np.zeros(n, np.uint32),
        },
    )
    u = np.column_stack([c[f"u{i + 1}"] for i in range(4)])
    if version == "new":
        thrust = thrust_factor * u**2 + (1 - thrust_factor) * u
        control = np.full((n, 12), np.nan)
        control[:, :4] = thrust
        log.parameter("THR_MDL_FAC", float(thrust_factor))
        log.parameter("CA_ROTOR_COUNT", 4)
        for i, rotor in enumerate(vehicle().rotors):
            for axis, value in zip(
                ("PX", "PY", "PZ"), rotor.position * np.array([1.0, -1.0, -1.0]), strict=True
            ):
                log.parameter(f"CA_ROTOR{i}_{axis}", float(value))
            log.parameter(f"CA_ROTOR{i}_KM", 0.05 * rotor.spin)
        sampled = (stamps - 2000).astype(np.uint64)
        log.topic(
            "actuator_motors",
            stamps,
            {"timestamp_sample": sampled, "control": control.astype(np.float32)},
        )
        fields = {
            "position": np.column_stack(to_ned(c, ("sp_x", "sp_y", "sp_z"))).astype(np.float32)
        }
        log.topic("trajectory_setpoint", stamps[::10], {k: v[::10] for k, v in fields.items()})
    else:
        log.parameter("PWM_MIN", 1075)
        log.parameter("PWM_MAX", 1950)
        log.parameter("MAV_TYPE", 2)
        pwm = np.full((n, 16), 900.0)
        pwm[:, :4] = 1075 + u * (1950 - 1075)
        still = np.full((n, 16), 1000.0)
        log.topic(
            "actuator_outputs",
            stamps,
            {"noutputs": np.full(n, 8, np.uint32), "output": still.astype(np.float32)},
        )
        log.topic(
            "actuator_outputs",
            stamps,
            {"noutputs": np.full(n, 4, np.uint32), "output": pwm.astype(np.float32)},
            instance=1,
        )
    log.topic(
        "vehicle_attitude",
        stamps[::pose_every],
        {"q": px4_attitude(c)[::pose_every].astype(np.float32)},
    )
    place = dict(zip("xyz", to_ned(c, ("x", "y", "z")), strict=True))
    speed = dict(zip(("vx", "vy", "vz"), to_ned(c, ("vx", "vy", "vz")), strict=True))
    local = {k: v[::slow_every].astype(np.float32) for k, v in (place | speed).items()}
    log.topic("vehicle_local_position", stamps[::slow_every], local)
    log.topic("battery_status", stamps[::20], {"voltage_v": c["vbat"][::20].astype(np.float32)})
    if change is not None:
        change(log, stamps)
    path.write_bytes(log.bytes())
    return path


# Crazyflie micro-SD card --------------------------------------------------------------------------------------------


def usd_bytes(
    events: Sequence[tuple[str, Sequence[tuple[str, str]], np.ndarray, np.ndarray]],
    version: int = 2,
) -> bytes:
    """Bytes of a log: per event its name, (variable, type character), stamps [ms or us], values (N,
    K)."""
    out = struct.pack("<BHH", 0xBC, version, len(events))
    rows = []
    for number, (name, variables, stamps, values) in enumerate(events):
        out += struct.pack("<H", number) + name.encode() + b"\0" + struct.pack("<H", len(variables))
        out += b"".join(f"{v}({c})".encode() + b"\0" for v, c in variables)
        layout = struct.Struct("<" + "".join(c for _, c in variables))
        head = struct.Struct("<HI" if version == 1 else "<HQ")
        for stamp, row in zip(stamps, values, strict=True):
            items = [
                float(x) if c in "fd" else round(float(x))
                for x, (_, c) in zip(row, variables, strict=True)
            ]
            rows.append((int(stamp), head.pack(number, int(stamp)) + layout.pack(*items)))
    out += b"".join(b for _, b in sorted(rows, key=lambda pair: pair[0]))
    return out + struct.pack("<I", zlib.crc32(out))


def write_crazyflie(path: Path, c: Columns, *, version: int = 2) -> Path:
    """The flight as the micro-SD deck would have logged it."""
    scale = 1e3 if version == 1 else 1e6
    fast = [
        ("gyro.x", "f"),
        ("gyro.y", "f"),
        ("gyro.z", "f"),
        ("acc.x", "f"),
        ("acc.y", "f"),
        ("acc.z", "f"),
    ]
    fast += [(f"motor.m{i}", "H") for i in (1, 2, 3, 4)]
    fast += [("pm.vbat", "f")]
    values = [np.rad2deg(c[k]) for k in "pqr"] + [c[k] / GRAVITY for k in ("ax", "ay", "az")]
    values += [c[f"u{i}"] * 65535 for i in (1, 2, 3, 4)] + [c["vbat"]]
    pose = [
        (f"stateEstimate.{n}", "f")
        for n in ("qw", "qx", "qy", "qz", "x", "y", "z", "vx", "vy", "vz")
    ]
    poses = np.column_stack(
        [c[k] for k in ("qw", "qx", "qy", "qz", "x", "y", "z", "vx", "vy", "vz")]
    )
    stamps = np.rint((c["t"] + 12.5) * scale)
    events = [
        ("fixedFrequency", fast, stamps, np.column_stack(values)),
        ("estimate", pose, stamps, poses),
    ]
    path.write_bytes(usd_bytes(events, version))
    return path


# ArduPilot DataFlash ------------------------------------------------------------------------------------------------

DATAFLASH = {"Q": "Q", "B": "B", "b": "b", "H": "H", "f": "f", "N": "16s", "n": "4s", "Z": "64s"}


def dataflash_bytes(messages: Sequence[tuple[str, str, str, Sequence[tuple[Any, ...]]]]) -> bytes:
    """(name, letters, fields, rows) of messages as an onboard log: what they are first, then in
    turn by their time."""

    def declared(number: int, length: int, name: str, letters: str, fields: str) -> bytes:
        texts = [
            text.encode().ljust(size, b"\0")
            for text, size in ((name, 4), (letters, 16), (fields, 64))
        ]
        return b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", number, length, *texts)

    out = declared(0x80, 89, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns")
    rows: list[tuple[float, bytes]] = []
    for number, (name, letters, fields, values) in enumerate(messages, start=0x81):
        layout = struct.Struct("<" + "".join(DATAFLASH[c] for c in letters))
        out += declared(number, layout.size + 3, name, letters, fields)
        rows += [(row[0], b"\xa3\x95" + bytes([number]) + layout.pack(*row)) for row in values]
    return out + b"".join(body for _, body in sorted(rows, key=lambda pair: pair[0]))


PWM_RANGE = (("MOT_PWM_MIN", 1000.0), ("MOT_PWM_MAX", 2000.0))


def write_ardupilot(
    path: Path, c: Columns, pwm_range: Sequence[tuple[str, float]] = PWM_RANGE
) -> Path:
    """The flight as ArduPilot would have logged it, with a second IMU that says something else."""
    stamps = [int(t) for t in np.rint((c["t"] + 12.5) * 1e6)]
    imu = np.column_stack([*to_frd(c, "pqr"), *to_frd(c, ("ax", "ay", "az"))])
    pose = np.column_stack([*to_ned(c, "xyz"), *to_ned(c, ("vx", "vy", "vz"))])
    turned = px4_attitude(c)
    pwm = [np.rint(1000 + 1000 * c[f"u{i}"]).astype(int) for i in (2, 1, 4, 3)]
    parameters = [
        (f"SERVO{k}_FUNCTION", 33.0 + m) for k, m in ((1, 1), (2, 0), (3, 3), (4, 2), (5, -33))
    ]
    parameters += pwm_range

    def rows(table: np.ndarray, *before: int) -> list[tuple[Any, ...]]:
        return [(t, *before, *map(float, row)) for t, row in zip(stamps, table, strict=True)]

    path.write_bytes(
        dataflash_bytes(
            [
                ("PARM", "QNf", "TimeUS,Name,Value", [(0, n.encode(), v) for n, v in parameters]),
                (
                    "IMU",
                    "QBffffff",
                    "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ",
                    rows(imu, 0) + rows(-imu, 1),
                ),
                ("XKQ", "QBffff", "TimeUS,C,Q1,Q2,Q3,Q4", rows(turned, 0)),
                ("XKF1", "QBffffff", "TimeUS,C,PN,PE,PD,VN,VE,VD", rows(pose, 0)),
                (
                    "RCOU",
                    "QHHHH",
                    "TimeUS,C1,C2,C3,C4",
                    [(t, *map(int, u)) for t, *u in zip(stamps, *pwm, strict=True)],
                ),
                ("BAT", "QBf", "TimeUS,Inst,Volt", rows(c["vbat"][:, None], 0)),
            ]
        )
    )
    return path


# Betaflight blackbox ------------------------------------------------------------------------------------------------


def _unsigned(value: int) -> bytes:
    out = b""
    while value > 127:
        out += bytes([value & 127 | 128])
        value >>= 7
    return out + bytes([value])


def _signed(value: int) -> bytes:
    """ZigZag, then seven bits a byte."""
    return _unsigned(((value << 1) ^ (value >> 31)) & 0xFFFFFFFF)


def blackbox_bytes(
    fields: Mapping[str, np.ndarray], headers: Mapping[str, str], least: int | None = None
) -> bytes:
    """A blackbox log of I frames: every field a signed variable-byte integer without a prediction,
    and motor[0] as the firmware writes it where its `least` output is given."""
    names = ["loopIteration", *fields]
    n = len(next(iter(fields.values())))
    out = "H Product:Blackbox flight data recorder by Nicholas Sherlock\nH Data version:2\n"
    out += "H I interval:1\nH P interval:1/1\n"
    out += "H Field I name:" + ",".join(names) + "\n"
    own = names.index("motor[0]") if least is not None else -1
    for key in ("signed", "predictor", "encoding"):
        one = {"signed": "1", "predictor": "0", "encoding": "0"}[key]
        firmware = {"signed": "0", "predictor": "11", "encoding": "1"}[key]
        codes = [firmware if k == own else one for k in range(len(names))]
        out += f"H Field I {key}:" + ",".join(codes) + "\n"
    for key in ("predictor", "encoding"):
        out += f"H Field P {key}:" + ",".join(["0"] * len(names)) + "\n"
    out += "".join(f"H {k}:{v}\n" for k, v in headers.items())
    table = np.column_stack([np.arange(n), *(np.rint(v).astype(np.int64) for v in fields.values())])

    def frame(row: np.ndarray) -> bytes:
        return b"I" + b"".join(
            _unsigned((int(v) - (least or 0)) & 0xFFFFFFFF) if k == own else _signed(int(v))
            for k, v in enumerate(row)
        )

    frames = b"".join(map(frame, table))
    return out.encode() + frames + b"E\xff" + b"End of log\0"


def write_betaflight(path: Path, c: Columns, *, headers: Mapping[str, str] | None = None) -> Path:
    """The flight as Betaflight would have logged it, at 16 times the resolution of its integer
    fields where it scales."""
    own = {
        "Firmware revision": "Betaflight 4.4.2 (23d066d08) STM32F7X2",
        "Craft name": "nano",
        "motorOutput": "48,2047",
        "gyro_scale": "0x3f800000",
        "acc_1G": "2048",
        "vbatref": "420",
        "motor_poles": "14",
    }
    fields = {"time": c["t"] * 1e6 + 5e6}
    fields |= {f"gyroADC[{i}]": np.rad2deg(c[k]) for i, k in enumerate("pqr")}
    fields |= {f"accSmooth[{i}]": c[k] / GRAVITY * 2048 for i, k in enumerate(("ax", "ay", "az"))}
    fields |= {f"motor[{i}]": 48 + c[f"u{i + 1}"] * (2047 - 48) for i in range(4)}
    fields |= {"vbatLatest": c["vbat"] * 100}
    path.write_bytes(
        blackbox_bytes({k: np.nan_to_num(v) for k, v in fields.items()}, own | dict(headers or {}))
    )
    return path


# ROS, MATLAB, Parquet, CSV: by the formats' own libraries -----------------------------------------------------------


def write_ros(path: Path, c: Columns, *, kind: str = "mcap", received_late: float = 0.004) -> Path:
    """A bag by rosbags' writers: `bag` (ROS 1), `sqlite` or `mcap` (ROS 2 folders); returns what a
    user would pass."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if kind == "bag" else Stores.ROS2_HUMBLE)
    T = store.types
    header, time = T["std_msgs/msg/Header"], T["builtin_interfaces/msg/Time"]
    vector, quat, point = (T[f"geometry_msgs/msg/{n}"] for n in ("Vector3", "Quaternion", "Point"))
    imu, odometry, array = (
        T["sensor_msgs/msg/Imu"],
        T["nav_msgs/msg/Odometry"],
        T["std_msgs/msg/Float32MultiArray"],
    )
    layout = T["std_msgs/msg/MultiArrayLayout"]
    pose, pose_c = T["geometry_msgs/msg/Pose"], T["geometry_msgs/msg/PoseWithCovariance"]
    twist, twist_c = T["geometry_msgs/msg/Twist"], T["geometry_msgs/msg/TwistWithCovariance"]
    none, many = np.zeros(9), np.zeros(36)
    extra = {"seq": 0} if kind == "bag" else {}
    writer: Any = (
        Writer1(path)
        if kind == "bag"
        else Writer2(
            path,
            version=8,
            storage_plugin=StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3,
        )
    )
    with writer:
        to = {
            name: writer.add_connection(name, message, typestore=store)
            for name, message in (
                ("/imu", imu.__msgtype__),
                ("/odom", odometry.__msgtype__),
                ("/motors", array.__msgtype__),
            )
        }
        serialize = store.serialize_ros1 if kind == "bag" else store.serialize_cdr
        body = [
            rotation(q).T @ v
            for q, v in zip(
                np.column_stack([c[k] for k in ("qw", "qx", "qy", "qz")]),
                np.column_stack([c[k] for k in ("vx", "vy", "vz")]),
                strict=True,
            )
        ]
        for i, t in enumerate(c["t"]):
            nanoseconds = round((t + 1_700_000_000) * 1e9)
            stamp = header(
                stamp=time(nanoseconds // 10**9, nanoseconds % 10**9), frame_id="base", **extra
            )
            late = nanoseconds + round(received_late * 1e9)
            q = quat(*(float(c[k][i]) for k in ("qx", "qy", "qz", "qw")))
            message = imu(
                stamp,
                quat(0.0, 0.0, 0.0, 0.0),
                none,
                vector(*(float(c[k][i]) for k in "pqr")),
                none,
                vector(*(float(c[k][i]) for k in ("ax", "ay", "az"))),
                none,
            )
            writer.write(to["/imu"], late, serialize(message, imu.__msgtype__))
            place = pose_c(pose(point(*(float(c[k][i]) for k in "xyz")), q), many)
            moving = twist_c(twist(vector(*map(float, body[i])), vector(0.0, 0.0, 0.0)), many)
            writer.write(
                to["/odom"],
                late,
                serialize(odometry(stamp, "base", place, moving), odometry.__msgtype__),
            )
            u = np.array([c[f"u{j}"][i] for j in (1, 2, 3, 4)], dtype=np.float32)
            # A message without a header has the time of reception only.
            writer.write(
                to["/motors"], nanoseconds, serialize(array(layout([], 0), u), array.__msgtype__)
            )
    return path


ROS_MAPPING = """schema = "greybox.mapping/1"
[command]
stream = "/motors"
fields = ["data[0]", "data[1]", "data[2]", "data[3]"]
"""


def own_columns(c: Columns) -> dict[str, np.ndarray]:
    """Some laboratory's own table: milliseconds, degrees, g, PWM, FRD and NED."""
    out = {"time_ms": c["t"] * 1e3}
    out |= {
        f"gyr_{k}": np.rad2deg(v) for k, v in zip("xyz", to_frd(c, ("p", "q", "r")), strict=True)
    }
    out |= {
        f"acc_{k}": v / GRAVITY for k, v in zip("xyz", to_frd(c, ("ax", "ay", "az")), strict=True)
    }
    out |= {f"pwm{i}": 1000 + 1000 * c[f"u{i}"] for i in (1, 2, 3, 4)}
    out |= {f"pos_{k}": 1e3 * v for k, v in zip("ned", to_ned(c, ("x", "y", "z")), strict=True)}
    out |= {f"att_{j}": v for j, v in enumerate(px4_attitude(c).T)}
    return out


OWN_MAPPING = """schema = "greybox.mapping/1"
[time]
field = "time_ms"
[rate]
fields = ["gyr_x", "gyr_y", "gyr_z"]
unit = "deg/s"
frame = "FRD"
[specific_force]
fields = ["acc_x", "acc_y", "acc_z"]
unit = "g"
frame = "FRD"
[command]
fields = ["pwm1", "pwm2", "pwm3", "pwm4"]
limits = [1000, 2000]
[position]
fields = ["pos_n", "pos_e", "pos_d"]
unit = "mm"
frame = "NED"
[attitude]
fields = ["att_0", "att_1", "att_2", "att_3"]
frame = "FRD/NED"
"""


def write_csv(path: Path, columns: Columns) -> Path:
    rows = [",".join(columns)] + [
        ",".join(map(repr, map(float, r))) for r in zip(*columns.values(), strict=True)
    ]
    path.write_text("\n".join(rows) + "\n")
    return path


def write_parquet(path: Path, columns: Columns) -> Path:
    import pyarrow as pa
    import pyarrow.parquet as pq

    pq.write_table(pa.table(dict(columns)), path)
    return path


def write_mat(path: Path, columns: Columns) -> Path:
    from scipy.io import savemat

    savemat(path, dict(columns), do_compression=True)
    return path
