"""PX4 ULog files by pyulog: every topic and instance is a stream; `px4` knows which of them are
which channels.

Stamps are microseconds since boot; a measurement takes `timestamp_sample` where the topic has it.
Reference: ULog file format, docs.px4.io.
"""

from __future__ import annotations

import contextlib
import io
import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from greybox.data.readers.px4 import rotors_of, servos_among, sources_of
from greybox.data.readers.recording import (
    LogFormat,
    Recording,
    Stream,
    as_numbers,
    checked_file,
    damaged,
    library,
)
from greybox.errors import DataError

if TYPE_CHECKING:
    from pyulog import ULog

_MAGIC = b"ULog\x01\x12\x35"

OURS = "greybox"
"""`sys_name` of what `greybox validate --ulog` writes, whose estimates are predictions of a
model."""

WIDEST_FORMAT = 20_000
"""Fields of one message, arrays and nested types unfolded, above which a file is refused."""

_MEMBER = re.compile(r"([A-Za-z0-9_]+)(?:\[(\d+)\])?\s")


def read_ulog(path: Path) -> Recording:
    """Read a ULog file. Raises `DataError`. A log that was cut off, or has damaged parts, is read
    as far as it goes."""
    where = str(path)
    digest = checked_file(path)
    core = library("pyulog", where=where, what="a ULog file")
    # pyulog prints what it thinks of a file; standard output is for results.
    with (
        damaged(where, "a ULog file"),
        path.open("rb") as file,
        contextlib.redirect_stdout(io.StringIO()),
    ):
        _demand_small_formats(file, where)
        log = core.ULog(file)
        streams = dict(_streams(log))
        parameters = {
            str(k): float(v)
            for k, v in log.initial_parameters.items()
            if isinstance(v, (int, float))
        }
        info = _info(log)
        dropouts = tuple((d.timestamp * 1e-6, d.duration * 1e-3) for d in log.dropouts)
        notes = (
            ["parts of the file are damaged and were passed over"] if log.file_corruption else []
        )
    if log.msg_info_dict.get("sys_name") == OURS:
        raise DataError(
            "predictions of a model, written for Flight Review, not a flight",
            where=where,
            fix="give the log that it was made of",
        )
    if not streams:
        raise DataError("a ULog file without samples", where=where, fix="copy the log again")
    for name in sorted({k for _, k, _ in log.changed_parameters}):
        if name.startswith(("THR_MDL_FAC", "PWM_", "CA_ROTOR", "DSHOT_MIN", "SIM_GZ_EC")):
            notes.append(f"parameter {name} was changed during the log; its first value is used")
    rotors = rotors_of(parameters)
    factor = parameters.get("THR_MDL_FAC", 0.0)
    if not 0.0 <= factor <= 1.0:
        notes.append(f"THR_MDL_FAC = {factor:g} is not between 0 and 1; taken as 0")
        factor = 0.0
    if servos_among(parameters):
        notes.append(
            "a VTOL: servos stand among its outputs, so that outputs without a function are no "
            "rotors ([command] fields in a mapping file say which are)"
        )
    return Recording(
        format="ulog",
        source=path.name,
        sha256=digest,
        streams=streams,
        sources=tuple(sources_of(streams, parameters, factor, len(rotors))),
        info=info,
        dropouts=dropouts,
        rotors=rotors,
        parameters=parameters,
        notes=tuple(notes),
    )


def _demand_small_formats(file: BinaryIO, where: str) -> None:
    """Refuse message formats that unfold into absurdly many fields (arrays of nested types): they
    would fill the memory.

    Raises `DataError`. Leaves the file at its beginning.
    """
    file.seek(16)
    formats: dict[str, list[tuple[str, int]]] = {}
    while len(head := file.read(3)) == 3:
        size, kind = struct.unpack("<HB", head)
        if kind in b"AD":
            break
        content = file.read(size)
        if kind == ord("F"):
            name, _, members = content.decode("utf-8", "replace").partition(":")
            found = (_MEMBER.match(m.strip()) for m in members.split(";"))
            formats[name] = [(m[1], int((m[2] or "1")[:9])) for m in found if m]
    file.seek(0)

    def width(name: str, depth: int) -> int:
        if name not in formats:
            return 1
        if depth > 8:
            return WIDEST_FORMAT + 1
        total = 0
        for kind, count in formats[name]:
            total += count * width(kind, depth + 1)
            if total > WIDEST_FORMAT:
                break
        return total

    for name in formats:
        if width(name, 0) > WIDEST_FORMAT:
            raise DataError(
                f"message format '{name[:40]}' has more than {WIDEST_FORMAT} fields",
                where=where,
                fix="copy the log again; no version of PX4 writes such a format",
            )


def _streams(log: ULog) -> Iterator[tuple[str, Stream]]:
    """Every topic and instance: instance 0 under the topic's name, others as topic[1]."""
    for data in sorted(log.data_list, key=lambda d: (d.name, d.multi_id)):
        name = data.name if data.multi_id == 0 else f"{data.name}[{data.multi_id}]"
        fields = {}
        unread = []
        for key, values in data.data.items():
            numbers = as_numbers(values)
            if numbers is None:
                unread.append(key)
            else:
                fields[key] = numbers
        if "timestamp" not in fields or fields["timestamp"].size == 0:
            continue
        stamps, clock = fields["timestamp"], "timestamp, microseconds since boot"
        # A command counts from when it was sent; its timestamp_sample is that of the gyro it
        # answers.
        if "timestamp_sample" in fields and not data.name.startswith("actuator"):
            sampled = fields["timestamp_sample"]
            if (sampled > 0).all() and np.abs(stamps - sampled).max() < 1e6:
                stamps, clock = sampled, "timestamp_sample, microseconds since boot"
        if data.name == "vehicle_imu":
            for part in ("angle", "velocity"):
                span = fields.get(f"delta_{part}_dt")
                for axis in range(3):
                    key = f"delta_{part}[{axis}]"
                    if span is not None and key in fields:
                        with np.errstate(divide="ignore", invalid="ignore"):
                            fields[f"{key} / dt"] = np.where(
                                span > 0, fields[key] / (span * 1e-6), np.nan
                            )
        yield (
            name,
            Stream(
                name=name,
                t=stamps * 1e-6,
                fields=fields,
                kind=data.name,
                clock=clock,
                unread=tuple(unread),
            ),
        )


def _info(log: ULog) -> dict[str, str]:
    known = log.msg_info_dict
    out = {}
    for key, label in (
        ("sys_name", "system"),
        ("ver_hw", "hardware"),
        ("sys_os_name", "operating system"),
    ):
        if isinstance(known.get(key), str):
            out[label] = known[key]
    version = log.get_version_info_str()
    if version:
        out["firmware"] = version
    profile = log.initial_parameters.get("SDLOG_PROFILE")
    if profile is not None:
        out["SDLOG_PROFILE"] = str(int(profile))
    return out


FORMAT = LogFormat(
    name="ulog",
    title="PX4 ULog",
    endings=(".ulg", ".ulog"),
    recognise=lambda path, head: head.startswith(_MAGIC),
    recording=read_ulog,
    libraries=("pyulog",),
    advice={
        "": "SDLOG_PROFILE = 25 (bit 0 default, bit 3 system identification, bit 4 high rate) logs "
        "gyro, accelerometer, attitude and motor commands at full rate; SDLOG_MODE = 0 logs from "
        "arming to disarming; a fast SD card avoids drop-outs. etc/logging/logger_topics.txt on "
        "the SD card (lines of topic and interval in ms) replaces the whole profile: where it is "
        "used, it must name every topic",
        "command": "set bit 3 or 4 of SDLOG_PROFILE (8 or 16): actuator_motors at full rate, by "
        "default it is 10 Hz; "
        "before PX4 1.13: actuator_outputs in etc/logging/logger_topics.txt on the SD card",
        "rotor_speed": "ESCs with telemetry (DShot: DSHOT_TEL_CFG; bidirectional DShot; UAVCAN): "
        "esc_status; bit 4 of SDLOG_PROFILE (16) logs it at 200 Hz",
        "battery": "a power module (BAT1_V_CHANNEL or its driver): battery_status, 5 Hz by "
        "default; `battery_status 20` in etc/logging/logger_topics.txt for 50 Hz",
        "attitude": "bit 4 of SDLOG_PROFILE (16): vehicle_attitude at full rate, by default it is "
        "20 Hz",
        "rate": "bit 3 or 4 of SDLOG_PROFILE (8 or 16): sensor_combined and "
        "vehicle_angular_velocity at full rate",
        "specific_force": "bit 3 of SDLOG_PROFILE (8): sensor_combined and vehicle_acceleration at "
        "full rate",
        "position": "an estimate needs GPS, optical flow or external poses; bit 7 of SDLOG_PROFILE "
        "(128) logs motion capture (vehicle_visual_odometry); `vehicle_local_position 10` in "
        "etc/logging/logger_topics.txt for 100 Hz",
        "velocity": "as position: `vehicle_local_position 10` in etc/logging/logger_topics.txt on "
        "the SD card for 100 Hz",
        "setpoint": "trajectory_setpoint is logged in position modes (5 Hz by default)",
    },
)
