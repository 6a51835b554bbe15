"""ArduPilot's onboard logs (DataFlash, .bin).

Layout (ArduPilot, libraries/AP_Logger), little endian: every message is 0xA3, 0x95, a type byte,
and a body whose length and fields a message of type 0x80 (FMT: type, length of the whole, name, a
letter per field, names of fields) gave before. Units and axes are those of the published list of
messages: body axes forward, right, down; world axes north, east, down. SampleUS (of GYR and ACC)
is when a sample was taken, TimeUS when it was written (libraries/AP_InertialSensor/
AP_InertialSensor_Logging.cpp): samples of one read of a FIFO are written together.

The reader is our own: the library that others use (pymavlink) parses in C what a file declares,
prints what it skips, and makes one Python object a message. The tests hold one against the other.
No log of a real flight was read with it yet.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from greybox.data.readers.recording import (
    LogFormat,
    Recording,
    Source,
    Stream,
    checked_file,
    damaged,
)
from greybox.errors import DataError

_HEAD = b"\xa3\x95"
_FMT, _FMT_LENGTH = 0x80, 89
_LETTERS: Mapping[str, tuple[str, float]] = {
    "b": ("i1", 1.0),
    "B": ("u1", 1.0),
    "h": ("<i2", 1.0),
    "H": ("<u2", 1.0),
    "i": ("<i4", 1.0),
    "I": ("<u4", 1.0),
    "q": ("<i8", 1.0),
    "Q": ("<u8", 1.0),
    "g": ("<f2", 1.0),
    "f": ("<f4", 1.0),
    "d": ("<f8", 1.0),
    "M": ("u1", 1.0),
    "c": ("<i2", 1e-2),
    "C": ("<u2", 1e-2),
    "e": ("<i4", 1e-2),
    "E": ("<u4", 1e-2),
    "L": ("<i4", 1e-7),
    "n": ("S4", 0.0),
    "N": ("S16", 0.0),
    "Z": ("S64", 0.0),
    "a": ("V64", 0.0),
}
"""Letter of a field -> (NumPy type, factor); 0: no number."""
_INSTANCE = ("I", "C", "Inst", "Instance")
"""Fields that tell which of several sensors or estimators a message is of."""
MOTOR1 = 33.0
"""Function of a servo output that is motor 1; motors 2 to 8 follow."""


@dataclass(frozen=True, kw_only=True)
class _Kind:
    """One type of message: its name, length with the head [B], field names and their layout."""

    name: str
    length: int
    letters: str
    layout: np.dtype[np.void]


def read_ardupilot(path: Path) -> Recording:
    """Read an onboard log. Raises `DataError`; a log that was cut off is read as far as it goes."""
    where = str(path)
    digest = checked_file(path)
    with damaged(where, "an ArduPilot log"):
        data = path.read_bytes()
        if not data.startswith(_HEAD + bytes([_FMT])):
            raise DataError(
                "no ArduPilot log", where=where, expected="a message that declares messages first"
            )
        kinds, places, refused, skipped = _messages(data)
        streams: dict[str, Stream] = {}
        parameters: dict[str, float] = {}
        for number, kind in kinds.items():
            table = _table(data, kind, places.get(number, []))
            if kind.name == "PARM":
                parameters |= _parameters(table)
            elif table.size:
                streams |= {s.name: s for s in _streams(kind, table)}
    if not streams:
        raise DataError("a log without messages", where=where, fix="copy the log again")
    return Recording(
        format="ardupilot",
        source=path.name,
        sha256=digest,
        streams=streams,
        sources=tuple(_sources(streams, parameters)),
        parameters=parameters,
        notes=tuple(_notes(refused, skipped)),
    )


def _notes(refused: list[str], skipped: int) -> Iterator[str]:
    """What of the log was not read."""
    if refused:
        yield (
            f"messages {', '.join(refused)} are not read: what they declare contradicts itself "
            "or is of no known kind"
        )
    if skipped:
        yield f"{skipped} bytes between messages are not read: the log is damaged"


def _messages(data: bytes) -> tuple[dict[int, _Kind], dict[int, list[int]], list[str], int]:
    """(types of messages, where the bodies of each begin, names of those that are declared as
    nothing that can be read, bytes that are of no message). The latter are passed over whole: what
    looks like a message inside them is none."""
    kinds: dict[int, _Kind] = {}
    refused: dict[int, str] = {}
    lengths = {_FMT: _FMT_LENGTH}
    places: dict[int, list[int]] = {}
    met: dict[int, None] = {}
    at, skipped = 0, 0
    while at + 3 <= len(data):
        number = data[at + 2]
        length = lengths.get(number, 0) if data[at : at + 2] == _HEAD else 0
        if not length or at + length > len(data):
            following = data.find(_HEAD, at + 1)
            following = len(data) if following < 0 else following
            # What is cut off at the end is no damage.
            skipped += following - at if following < len(data) or not length else 0
            at = following
            continue
        if number == _FMT:
            body = data[at + 3 : at + length]
            declared, whole = body[0], body[1]
            if declared != _FMT and declared not in kinds and whole >= 3:
                lengths[declared] = whole
                kind = _declared(body)
                if kind is not None:
                    kinds[declared] = kind
                else:
                    refused[declared] = (
                        body[2:6].split(b"\0")[0].decode("ascii", "replace") or f"{declared:#x}"
                    )
        elif number in kinds:
            places.setdefault(number, []).append(at + 3)
        else:
            met.setdefault(number)
        at += length
    return kinds, places, [refused[n] for n in met if n not in kinds], skipped


def _declared(body: bytes) -> _Kind | None:
    """What a FMT message declares; None for one that contradicts itself."""
    length = body[1]
    texts = [
        part.split(b"\0")[0].decode("ascii", "replace")
        for part in (body[2:6], body[6:22], body[22:86])
    ]
    name, letters = texts[0], texts[1]
    names = texts[2].split(",")
    if len(names) != len(letters) or len(set(names)) < len(names) or set(letters) - set(_LETTERS):
        return None
    layout = np.dtype([(n, _LETTERS[c][0]) for n, c in zip(names, letters, strict=True)])
    if not name or layout.itemsize != length - 3:
        return None
    return _Kind(name=name, length=length, letters=letters, layout=layout)


def _table(data: bytes, kind: _Kind, places: list[int]) -> npt.NDArray[np.void]:
    """The bodies of all messages of a kind (N,)."""
    size = kind.layout.itemsize
    return np.frombuffer(b"".join(data[p : p + size] for p in places), dtype=kind.layout)


def _parameters(table: npt.NDArray[np.void]) -> dict[str, float]:
    if not {"Name", "Value"} <= set(table.dtype.names or ()):
        return {}
    names = [bytes(n).decode("ascii", "replace") for n in table["Name"]]
    return {n: float(v) for n, v in zip(names, table["Value"], strict=True)}


def _streams(kind: _Kind, table: npt.NDArray[np.void]) -> Iterator[Stream]:
    """A stream per sensor of a kind of message that has a time."""
    names = kind.layout.names or ()
    scales = dict(zip(names, (_LETTERS[c][1] for c in kind.letters), strict=True))
    clock = next((n for n in ("SampleUS", "TimeUS", "TimeMS") if scales.get(n)), None)
    if clock is None:
        return
    which = next((n for n in _INSTANCE if n in names and table[n].dtype.kind in "iu"), None)
    parts = {"": table}
    if which is not None:
        parts = {f"[{int(k)}]": table[table[which] == k] for k in np.unique(table[which])}
    for label, part in parts.items():
        yield Stream(
            name=kind.name + label,
            t=part[clock].astype(np.float64) * (1e-3 if clock == "TimeMS" else 1e-6),
            fields={
                n: part[n].astype(np.float64) * s
                for n, s in scales.items()
                if s and n not in (clock, which)
            },
            kind=kind.name,
            clock="milliseconds since boot" if clock == "TimeMS" else "microseconds since boot",
            unread=tuple(n for n, s in scales.items() if not s),
        )


_CHOICES: tuple[tuple[str, str, tuple[str, ...], str, str, str], ...] = (
    # group, message, fields, unit, frame, note
    ("rate", "IMU", ("GyrX", "GyrY", "GyrZ"), "rad/s", "FRD", "low-pass filtered by the firmware"),
    ("rate", "GYR", ("GyrX", "GyrY", "GyrZ"), "rad/s", "FRD", "as sampled"),
    (
        "specific_force",
        "IMU",
        ("AccX", "AccY", "AccZ"),
        "m/s^2",
        "FRD",
        "low-pass filtered by the firmware",
    ),
    ("specific_force", "ACC", ("AccX", "AccY", "AccZ"), "m/s^2", "FRD", "as sampled"),
    ("attitude", "XKQ", ("Q1", "Q2", "Q3", "Q4"), "1", "FRD/NED", "estimate"),
    ("attitude", "NKQ", ("Q1", "Q2", "Q3", "Q4"), "1", "FRD/NED", "estimate"),
    (
        "attitude",
        "ATT",
        ("Roll", "Pitch", "Yaw"),
        "deg",
        "FRD/NED",
        "estimate, in steps of 0.01 deg",
    ),
    ("position", "XKF1", ("PN", "PE", "PD"), "m", "NED", "estimate"),
    ("position", "NKF1", ("PN", "PE", "PD"), "m", "NED", "estimate"),
    ("velocity", "XKF1", ("VN", "VE", "VD"), "m/s", "NED", "estimate"),
    ("velocity", "NKF1", ("VN", "VE", "VD"), "m/s", "NED", "estimate"),
    ("battery", "BAT", ("Volt",), "V", "", ""),
    ("battery", "CURR", ("Volt",), "V", "", ""),
)


def _sources(streams: Mapping[str, Stream], parameters: Mapping[str, float]) -> Iterator[Source]:
    for group, message, fields, unit, frame, note in _CHOICES:
        cores = (_flown_by(streams, message), 0)
        for stream in (message, *(f"{message}[{core}]" for core in dict.fromkeys(cores))):
            if stream in streams and set(fields) <= set(streams[stream].fields):
                yield Source(
                    group=group, stream=stream, fields=fields, unit=unit, frame=frame, note=note
                )
    outputs = [
        k for k in range(1, 15) if MOTOR1 <= parameters.get(f"SERVO{k}_FUNCTION", 0.0) < MOTOR1 + 8
    ]
    outputs.sort(key=lambda k: parameters[f"SERVO{k}_FUNCTION"])
    fields = tuple(f"C{k}" for k in outputs)
    if outputs and "RCOU" in streams and set(fields) <= set(streams["RCOU"].fields):
        low, high = parameters.get("MOT_PWM_MIN", 0.0), parameters.get("MOT_PWM_MAX", 0.0)
        told = high > low > 0
        limits = (low, high) if told else (1000.0, 2000.0)
        why = "" if told else " (assumed: the log has no MOT_PWM_MIN below MOT_PWM_MAX)"
        note = (
            f"PWM {limits[0]:g} to {limits[1]:g}{why}, motors 1 to {len(outputs)} as ArduPilot "
            "numbers them"
        )
        yield Source(group="command", stream="RCOU", fields=fields, limits=limits, note=note)


def _flown_by(streams: Mapping[str, Stream], message: str) -> int:
    """The estimator core that the craft flew by for most of the log: PI of XKF4 and NKF4
    (libraries/AP_NavEKF3/LogStructure.h); 0 of other messages."""
    states = streams.get(f"{message[:2]}F4[0]") or streams.get(f"{message[:2]}F4")
    if message[:2] not in ("XK", "NK") or states is None or "PI" not in states.fields:
        return 0
    return max(int(np.median(states.fields["PI"])), 0)


FORMAT = LogFormat(
    name="ardupilot",
    title="ArduPilot DataFlash",
    endings=(".bin",),
    recognise=lambda path, head: head.startswith(_HEAD + bytes([_FMT])),
    recording=read_ardupilot,
    advice={
        "": "set bits 0 (ATTITUDE_FAST), 10 (RCOUT) and 18 (IMU_FAST) of LOG_BITMASK",
        "command": "set bit 10 (RCOUT) of LOG_BITMASK; PWM of SERVOn with function 33 (motor 1) "
        "and on; in most versions at 10 Hz, which is too slow",
        "rate": "set bit 18 (IMU_FAST) of LOG_BITMASK: IMU at the rate of the main loop instead of "
        "25 Hz",
        "specific_force": "set bit 18 (IMU_FAST) of LOG_BITMASK",
        "attitude": "set bit 0 (ATTITUDE_FAST) of LOG_BITMASK",
        "position": "the estimate XKF1 comes with EKF3; log motion capture beside it",
        "velocity": "the estimate XKF1 comes with EKF3",
        "battery": "set bit 9 (CURRENT) of LOG_BITMASK, with a battery monitor (BATT_MONITOR)",
        "setpoint": "not read from ArduPilot's logs",
    },
)
