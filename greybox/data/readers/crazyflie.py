"""Crazyflie logs of the micro-SD card deck: the binary format of the firmware's usddeck.

Layout (Bitcraze, crazyflie-firmware, src/deck/drivers/src/usddeck.c and tools/usdlog), little
endian: byte 0xBC; version uint16 (1 or 2); number of event types uint16; per type: id uint16, name
ending in 0, number of variables uint16, per variable "name(c)" ending in 0 with c its type as in
Python's struct. Then events: id uint16, stamp (version 1: uint32 milliseconds, version 2: uint64
microseconds), the packed variables. The last four bytes are the CRC-32 of all before.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from greybox.data.readers.recording import (
    LogFormat,
    Recording,
    Source,
    Stream,
    checked_file,
    damaged,
)
from greybox.errors import DataError

_MAGIC = 0xBC
_TYPES = "bBhHiIfd"
_VERSIONS = {1: ("<HI", 1e-3, "milliseconds"), 2: ("<HQ", 1e-6, "microseconds")}


@dataclass(frozen=True)
class _Event:
    name: str
    variables: tuple[str, ...]
    layout: struct.Struct


def read_crazyflie(path: Path) -> Recording:
    """Read a log of the micro-SD deck. Raises `DataError`; a log that was cut off is read as far as
    it goes."""
    where = str(path)
    digest = checked_file(path)
    data = path.read_bytes()
    if not _recognise(path, data[:512]):
        raise DataError(
            "no log of the Crazyflie's SD card",
            where=where,
            expected="byte 0xBC and version 1 or 2 first",
        )
    notes = []
    with damaged(where, "a Crazyflie log"):
        whole = len(data) > 9 and zlib.crc32(data[:-4]) == int.from_bytes(data[-4:], "little")
        body = data[:-4] if whole else data
        version, events, start = _header(body)
        rows, end = _events(body, start, version, events)
        if not whole:
            notes.append(
                f"the check sum is wrong: the log was cut off or damaged; {len(body) - end} bytes "
                "at its end are not read"
            )
        streams = {}
        for event in events.values():
            stamps, values = rows[event.name]
            if stamps:
                table = np.array(values, dtype=np.float64).reshape(
                    len(stamps), len(event.variables)
                )
                scale, unit = _VERSIONS[version][1:]
                streams[event.name] = Stream(
                    name=event.name,
                    t=np.array(stamps, dtype=np.float64) * scale,
                    fields={
                        n: np.ascontiguousarray(table[:, j]) for j, n in enumerate(event.variables)
                    },
                    kind="event",
                    clock=f"{unit} since boot",
                )
    if not streams:
        raise DataError(
            "a log without events",
            where=where,
            fix="copy the log again; switch logging on (usd.logging)",
        )
    return Recording(
        format="crazyflie",
        source=path.name,
        sha256=digest,
        streams=streams,
        sources=tuple(_sources(streams)),
        info={"format version": str(version)},
        notes=tuple(notes),
    )


def _text(data: bytes, start: int) -> tuple[str, int]:
    end = data.index(b"\0", start)
    return data[start:end].decode("utf-8"), end + 1


def _header(data: bytes) -> tuple[int, dict[int, _Event], int]:
    """(version, event types by id, where the events begin). Raises `struct.error` or
    `ValueError`."""
    version, count = struct.unpack_from("<HH", data, 1)
    at = 5
    events: dict[int, _Event] = {}
    for _ in range(count):
        (number,) = struct.unpack_from("<H", data, at)
        name, at = _text(data, at + 2)
        (variables,) = struct.unpack_from("<H", data, at)
        at += 2
        names, layout = [], "<"
        for _ in range(variables):
            text, at = _text(data, at)
            if len(text) < 4 or text[-3] != "(" or text[-1] != ")" or text[-2] not in _TYPES:
                raise ValueError(f"variable '{text[:40]}' has no known type")
            names.append(text[:-3])
            layout += text[-2]
        if any(e.name == name for e in events.values()) or len(set(names)) < len(names):
            raise ValueError(f"event or variable of '{name[:40]}' named twice")
        events[number] = _Event(name, tuple(names), struct.Struct(layout))
    return version, events, at


Rows = dict[str, tuple[list[int], list[tuple[float, ...]]]]


def _events(data: bytes, at: int, version: int, events: Mapping[int, _Event]) -> tuple[Rows, int]:
    """All events up to the end or the first that cannot be one, and where that is."""
    head = struct.Struct(_VERSIONS[version][0])
    rows: Rows = {e.name: ([], []) for e in events.values()}
    while at + head.size <= len(data):
        number, stamp = head.unpack_from(data, at)
        event = events.get(number)
        if event is None or at + head.size + event.layout.size > len(data):
            break
        stamps, values = rows[event.name]
        stamps.append(stamp)
        values.append(event.layout.unpack_from(data, at + head.size))
        at += head.size + event.layout.size
    return rows, at


_CHOICES: tuple[tuple[str, tuple[str, ...], str, str, str], ...] = (
    # group, variables, unit, frame, note
    ("rate", ("gyro.x", "gyro.y", "gyro.z"), "deg/s", "FLU", "low-pass filtered by the firmware"),
    ("rate", ("gyro_unfiltered.x", "gyro_unfiltered.y", "gyro_unfiltered.z"), "deg/s", "FLU", ""),
    # The firmware's pitch is nose up, and so is its rate where it is packed.
    (
        "rate",
        ("stateEstimateZ.rateRoll", "-stateEstimateZ.ratePitch", "stateEstimateZ.rateYaw"),
        "mrad/s",
        "FLU",
        "estimate",
    ),
    ("specific_force", ("acc.x", "acc.y", "acc.z"), "g", "FLU", ""),
    (
        "attitude",
        ("stateEstimate.qw", "stateEstimate.qx", "stateEstimate.qy", "stateEstimate.qz"),
        "1",
        "",
        "estimate",
    ),
    ("attitude", ("kalman.q0", "kalman.q1", "kalman.q2", "kalman.q3"), "1", "", "estimate"),
    ("attitude", ("locSrv.qw", "locSrv.qx", "locSrv.qy", "locSrv.qz"), "1", "", "external pose"),
    (
        "attitude",
        ("stateEstimate.roll", "-stateEstimate.pitch", "stateEstimate.yaw"),
        "deg",
        "",
        "estimate",
    ),
    ("attitude", ("stabilizer.roll", "-stabilizer.pitch", "stabilizer.yaw"), "deg", "", "estimate"),
    ("position", ("stateEstimate.x", "stateEstimate.y", "stateEstimate.z"), "m", "ENU", "estimate"),
    ("position", ("kalman.stateX", "kalman.stateY", "kalman.stateZ"), "m", "ENU", "estimate"),
    ("position", ("locSrv.x", "locSrv.y", "locSrv.z"), "m", "ENU", "external pose"),
    (
        "position",
        ("stateEstimateZ.x", "stateEstimateZ.y", "stateEstimateZ.z"),
        "mm",
        "ENU",
        "estimate",
    ),
    (
        "velocity",
        ("stateEstimate.vx", "stateEstimate.vy", "stateEstimate.vz"),
        "m/s",
        "ENU",
        "estimate",
    ),
    ("velocity", ("kalman.statePX", "kalman.statePY", "kalman.statePZ"), "m/s", "FLU", "estimate"),
    (
        "velocity",
        ("stateEstimateZ.vx", "stateEstimateZ.vy", "stateEstimateZ.vz"),
        "mm/s",
        "ENU",
        "estimate",
    ),
    ("battery", ("pm.vbat",), "V", "", ""),
    ("battery", ("pm.vbatMV",), "mV", "", ""),
    ("rotor_speed", ("rpm.m1", "rpm.m2", "rpm.m3", "rpm.m4"), "rpm", "", ""),
    ("setpoint", ("ctrltarget.x", "ctrltarget.y", "ctrltarget.z"), "m", "ENU", ""),
    ("setpoint", ("posCtl.targetX", "posCtl.targetY", "posCtl.targetZ"), "m", "ENU", ""),
)

_PWM = 65535.0
_COMMANDS = (
    ("motor.m1", "motor.m2", "motor.m3", "motor.m4"),
    ("pwm.m1_pwm", "pwm.m2_pwm", "pwm.m3_pwm", "pwm.m4_pwm"),
)


def _sources(streams: Mapping[str, Stream]) -> Iterator[Source]:
    """What the log variables are, whatever event they were logged in; events with more samples
    first."""
    names = sorted(streams, key=lambda n: -streams[n].n)
    for motors in _COMMANDS:
        for name in names:
            yield Source(group="command", stream=name, fields=motors, limits=(0.0, _PWM))
    for group, fields, unit, frame, note in _CHOICES:
        for name in names:
            yield Source(group=group, stream=name, fields=fields, unit=unit, frame=frame, note=note)


def _recognise(path: Path, head: bytes) -> bool:
    return len(head) >= 5 and head[0] == _MAGIC and int.from_bytes(head[1:3], "little") in _VERSIONS


FORMAT = LogFormat(
    name="crazyflie",
    title="Crazyflie micro-SD card",
    endings=(".usd",),
    recognise=_recognise,
    recording=read_crazyflie,
    advice={
        "": "config.txt on the SD card: 500 to 1000 Hz, one line per variable under "
        "on:fixedFrequency; keep the buffer at 512 bytes or more so that no event is lost",
        "command": "add motor.m1, motor.m2, motor.m3, motor.m4",
        "rotor_speed": "needs an RPM deck: add rpm.m1, rpm.m2, rpm.m3, rpm.m4",
        "battery": "add pm.vbat",
        "attitude": "add stateEstimate.qw, stateEstimate.qx, stateEstimate.qy, stateEstimate.qz",
        "rate": "add gyro.x, gyro.y, gyro.z (gyro_unfiltered.x, ... without the firmware's "
        "low-pass)",
        "specific_force": "add acc.x, acc.y, acc.z",
        "position": "needs a positioning system: add stateEstimate.x, stateEstimate.y, "
        "stateEstimate.z, or locSrv.x, locSrv.y, locSrv.z for the poses that motion capture sends",
        "velocity": "needs a positioning system: add stateEstimate.vx, stateEstimate.vy, "
        "stateEstimate.vz",
        "setpoint": "add ctrltarget.x, ctrltarget.y, ctrltarget.z",
    },
)
