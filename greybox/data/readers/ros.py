"""ROS 1 bags, ROS 2 bags (folder, .db3, .mcap) and MCAP files with JSON or protocol buffers, by
rosbags and mcap.

Every topic becomes a stream; nested fields get dotted names and short numeric arrays one field per
entry. Stamps are those of the message header where it has one, else of the reception. Well-known
types need no mapping file: sensor_msgs/Imu (REP 103, REP 145: body FLU, specific force),
geometry_msgs/PoseStamped, nav_msgs/Odometry (twist in body axes), sensor_msgs/BatteryState, and
PX4's px4_msgs, which carry uORB's fields in FRD and NED.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import is_dataclass, replace
from pathlib import Path
from typing import TypeGuard

import numpy as np

from greybox.data.raw import FloatArray
from greybox.data.readers.protobuf import Types, decode, described
from greybox.data.readers.px4 import sources_of
from greybox.data.readers.recording import (
    LogFormat,
    Recording,
    Source,
    Stream,
    checked_file,
    damaged,
    library,
)
from greybox.errors import DataError

_BAG = b"#ROSBAG V"
_MCAP = b"\x89MCAP0\r\n"
_SQLITE = b"SQLite format 3"

_RECOVER = (
    "copy it again; a recording that was cut off: `rosbag reindex`, `ros2 bag reindex` or "
    "`mcap recover`"
)

_STAMPS = ({"sec", "nanosec"}, {"secs", "nsecs"}, {"sec", "nsec"})
LONGEST_ARRAY = 16
"""Arrays of more entries than this (images, scans) are not read."""


def read_ros(path: Path) -> Recording:
    """Read a bag or an MCAP file. Raises `DataError`. Topics of unknown types are listed, not
    read."""
    where = str(path)
    digest = checked_file(path)
    rows: dict[str, _Topic] = {}
    unread: dict[str, str] = {}
    if not path.is_dir() and _head(path).startswith(_MCAP) and _plain_mcap(path, where):
        with damaged(where, "an MCAP file", fix=_RECOVER):
            _read_plain(path, where, rows)
    else:
        library("rosbags", where=where, what="a ROS bag")
        reader = library("rosbags.highlevel", where=where, what="a ROS bag")
        types = library("rosbags.typesys", where=where, what="a ROS bag")
        with damaged(where, "a ROS bag", fix=_RECOVER):
            store = types.get_typestore(types.Stores.ROS2_HUMBLE)
            with reader.AnyReader([_bag_of(path)], default_typestore=store) as bag:
                for connection, stamp, raw in bag.messages():
                    topic = rows.setdefault(connection.topic, _Topic(connection.msgtype))
                    if connection.topic in unread:
                        continue
                    try:
                        topic.add(stamp * 1e-9, bag.deserialize(raw, connection.msgtype))
                    except (KeyError, ValueError, reader.AnyReaderError) as error:
                        unread[connection.topic] = f"{connection.msgtype}: {type(error).__name__}"
    streams = {}
    for name, topic in sorted(rows.items()):
        if name not in unread and topic.n:
            streams[name] = topic.stream(name)
    if not streams:
        raise DataError(
            "no messages that can be read",
            where=where,
            got=", ".join(unread)[:120] or "an empty bag",
        )
    notes = [f"topic {name} was not read ({why})" for name, why in sorted(unread.items())]
    return Recording(
        format="ros",
        source=path.name,
        sha256=digest,
        streams=streams,
        sources=tuple(_sources(streams)),
        notes=tuple(notes),
    )


def _head(path: Path) -> bytes:
    with path.open("rb") as stream:
        return stream.read(64)


def _bag_of(path: Path) -> Path:
    """The folder of a ROS 2 bag for a .db3 file inside it, else the path itself."""
    return (
        path.parent if path.suffix == ".db3" and (path.parent / "metadata.yaml").exists() else path
    )


class _Topic:
    """The messages of one topic while they are read."""

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self.received: list[float] = []
        self.stamped: list[float] = []
        self.values: dict[str, list[float]] = {}
        self.unread: set[str] = set()
        self.n = 0

    def add(self, received: float, message: object) -> None:
        """Take one message."""
        self.received.append(received)
        stamp = np.nan
        for name, value in _leaves(message, "", self.unread, 0):
            if name == "header.stamp":
                stamp = value
                continue
            column = self.values.get(name)
            if column is None:
                column = self.values[name] = []
            if len(column) < self.n:
                column.extend([np.nan] * (self.n - len(column)))
            if len(column) == self.n:
                column.append(value)
        self.stamped.append(stamp)
        self.n += 1

    def stream(self, name: str) -> Stream:
        """All messages as one stream."""
        fields = {}
        for key, column in self.values.items():
            fields[key] = np.array(column + [np.nan] * (self.n - len(column)), dtype=np.float64)
        received, stamped = np.array(self.received), np.array(self.stamped)
        good = bool(np.isfinite(stamped).all() and (stamped > 0).all())
        t, clock = (stamped, "header stamp") if good else (received, "time of reception")
        if good and np.ptp(received - stamped) > 0:
            late = received - stamped
            clock += (
                f" (received {1e3 * np.median(late):.3g} ms later, spread "
                f"{1e3 * np.ptp(late):.3g} ms)"
            )
        if "px4_msgs" in self.kind and (own := _px4_stamps(self.kind, fields)) is not None:
            t, clock = own, "PX4's stamp"
        return Stream(
            name=name,
            t=t,
            fields=fields,
            kind=self.kind,
            clock=clock,
            unread=tuple(sorted(self.unread)),
        )


def _leaves(
    value: object, prefix: str, unread: set[str], depth: int
) -> Iterator[tuple[str, float]]:
    """Numbers of a message, under dotted names; a header's stamp is one number."""
    members: Mapping[str, object] | None = None
    if isinstance(value, Mapping):
        members = value
    elif is_dataclass(value):
        members = {
            f: getattr(value, f) for f in value.__dataclass_fields__ if not f.startswith("__")
        }
    if members is not None:
        keys = set(members)
        if any(pair <= keys for pair in _STAMPS) or keys == {"seconds", "nanos"}:
            fine = next(members[k] for k in ("nanosec", "nsecs", "nsec", "nanos") if k in members)
            coarse = next(members[k] for k in ("sec", "secs", "seconds") if k in members)
            if _is_number(coarse) and _is_number(fine):
                yield prefix, float(coarse) + 1e-9 * float(fine)
            return
        if depth < 8:
            for key, member in members.items():
                yield from _leaves(
                    member, f"{prefix}.{key}" if prefix else str(key), unread, depth + 1
                )
        return
    if _is_number(value):
        yield prefix, float(value)
    elif (
        isinstance(value, (list, tuple, np.ndarray))
        and 0 < len(value) <= LONGEST_ARRAY
        and depth < 8
    ):
        for j, entry in enumerate(value):
            yield from _leaves(entry, f"{prefix}[{j}]", unread, depth + 1)
    elif prefix:
        unread.add(prefix)


def _is_number(value: object) -> TypeGuard[bool | int | float | np.number | np.bool_]:
    return isinstance(value, (bool, int, float, np.integer, np.floating, np.bool_))


def _plain_mcap(path: Path, where: str) -> bool:
    """Whether an MCAP file is no bag of ROS: JSON or protocol buffers in all channels."""
    library("mcap", where=where, what="an MCAP file")
    reader = library("mcap.reader", where=where, what="an MCAP file")
    with damaged(where, "an MCAP file", fix=_RECOVER), path.open("rb") as stream:
        summary = reader.make_reader(stream).get_summary()
        channels = [] if summary is None else list(summary.channels.values())
        return bool(channels) and all(c.message_encoding in ("json", "protobuf") for c in channels)


def _read_plain(path: Path, where: str, rows: dict[str, _Topic]) -> None:
    reader = library("mcap.reader", where=where, what="an MCAP file")
    with path.open("rb") as stream:
        types: dict[int, Types] = {}
        for schema, channel, message in reader.make_reader(stream).iter_messages():
            topic = rows.setdefault(channel.topic, _Topic(schema.name if schema else "json"))
            if channel.message_encoding == "json":
                content = json.loads(message.data)
            else:
                if schema.id not in types:
                    types[schema.id] = described(schema.data)
                content = decode(types[schema.id], schema.name, message.data)
            topic.add(message.log_time * 1e-9, content)


_XYZ = ("x", "y", "z")
_WXYZ = ("w", "x", "y", "z")


def _vector(prefix: str, names: tuple[str, ...] = _XYZ) -> tuple[str, ...]:
    return tuple(f"{prefix}.{n}" for n in names)


def _entries(name: str, count: int = 3) -> tuple[str, ...]:
    return tuple(f"{name}[{i}]" for i in range(count))


def _sources(streams: Mapping[str, Stream]) -> Iterator[Source]:
    """What well-known message types hold; topics in the order of their names."""
    px4 = _px4(streams)
    for name, stream in streams.items():
        kind = stream.kind.rpartition("/")[2]
        if "px4_msgs" in stream.kind:
            yield from px4  # all at the first of them
        elif kind == "Imu":
            yield Source(group="rate", stream=name, fields=_vector("angular_velocity"), frame="FLU")
            yield Source(
                group="specific_force",
                stream=name,
                fields=_vector("linear_acceleration"),
                frame="FLU",
            )
            orientation = _vector("orientation", _WXYZ)
            if all(f in stream.fields for f in orientation) and np.any(
                stream.fields["orientation.w"] != 0
            ):
                yield Source(
                    group="attitude", stream=name, fields=orientation, note="orientation of the IMU"
                )
        elif kind in ("PoseStamped", "PoseWithCovarianceStamped", "Odometry"):
            inner = "pose" if kind == "PoseStamped" else "pose.pose"
            yield Source(
                group="attitude", stream=name, fields=_vector(f"{inner}.orientation", _WXYZ)
            )
            yield Source(group="position", stream=name, fields=_vector(f"{inner}.position"))
            if kind == "Odometry":
                yield Source(
                    group="velocity",
                    stream=name,
                    fields=_vector("twist.twist.linear"),
                    frame="FLU",
                    note="in body axes, as nav_msgs/Odometry says",
                )
        elif kind == "TransformStamped":
            yield Source(group="attitude", stream=name, fields=_vector("transform.rotation", _WXYZ))
            yield Source(group="position", stream=name, fields=_vector("transform.translation"))
        elif kind == "BatteryState":
            yield Source(group="battery", stream=name, fields=("voltage",))
        elif kind == "Actuators":
            for field in ("normalized", "angular_velocities", "velocity"):
                used = tuple(f for f in _entries(field, 8) if f in stream.fields)
                if used:
                    group = "command" if field == "normalized" else "rotor_speed"
                    yield Source(group=group, stream=name, fields=used)


def _px4_stamps(kind: str, fields: Mapping[str, FloatArray]) -> FloatArray | None:
    """When each message was sampled [s], or sent where that is not told, or where it is a command;
    None where no message says."""
    names = ["timestamp_sample", "timestamp"]
    if kind.rpartition("/")[2].startswith("Actuator"):
        names.reverse()
    return next((1e-6 * fields[n] for n in names if n in fields and (fields[n] > 0).all()), None)


def _px4(streams: Mapping[str, Stream]) -> Iterator[Source]:
    """What PX4's messages are as in its own logs, of all topics of one type in the order of their
    names. A bag has no parameters: motors are before THR_MDL_FAC and the idle, what the pulses of a
    driver mean is not known, nor whether EscStatus was measured: Gazebo repeats the commands in
    it."""
    of_kind: dict[str, list[str]] = {}
    for name, stream in streams.items():
        if "px4_msgs" in stream.kind:
            own = re.sub(r"(?<!^)(?=[A-Z])", "_", stream.kind.rpartition("/")[2]).lower()
            of_kind.setdefault(own, []).append(name)
    for unknown in ("actuator_outputs", "esc_status"):
        of_kind.pop(unknown, None)
    for k in range(max(map(len, of_kind.values()), default=0)):
        names = {kind: topics[k] for kind, topics in of_kind.items() if k < len(topics)}
        known = {kind: replace(streams[name], kind=kind) for kind, name in names.items()}
        for source in sources_of(known, {}, 0.0, 0):
            if source.stream in names:
                before = "before THR_MDL_FAC and idle"
                note = before if source.group == "command" else source.note
                yield replace(source, stream=names[source.stream], note=note)


def _recognise(path: Path, head: bytes) -> bool:
    if path.is_dir():
        return (path / "metadata.yaml").exists()
    return head.startswith((_BAG, _MCAP)) or (head.startswith(_SQLITE) and path.suffix == ".db3")


FORMAT = LogFormat(
    name="ros",
    title="ROS bag or MCAP",
    endings=(".bag", ".mcap", ".db3"),
    recognise=_recognise,
    recording=read_ros,
    libraries=("rosbags", "mcap"),
    advice={
        "": "record with header stamps of the sensors (not of the reception) and one clock "
        "(chrony or PTP between machines); a mapping file says which topics are which channels",
        "command": "record what is sent to each rotor, after the mixer (px4_msgs/ActuatorMotors, "
        "mav_msgs/Actuators, ESC commands), and name it in a mapping file; a body-rate or thrust "
        "setpoint is no rotor command",
        "rotor_speed": "record the ESC telemetry (mav_msgs/Actuators, mavros_msgs/ESCTelemetry)",
        "battery": "record sensor_msgs/BatteryState",
        "attitude": "record the pose (geometry_msgs/PoseStamped of motion capture, "
        "nav_msgs/Odometry of an estimator)",
        "rate": "record sensor_msgs/Imu at its full rate (mavros: imu/data_raw at 100 Hz or more)",
        "specific_force": "record sensor_msgs/Imu at its full rate; linear_acceleration must "
        "include gravity",
        "position": "record the pose of motion capture or of an estimator",
        "velocity": "record nav_msgs/Odometry, or a TwistStamped named in a mapping file with its "
        "frame",
        "setpoint": "record the position setpoint and name it in a mapping file",
    },
)
