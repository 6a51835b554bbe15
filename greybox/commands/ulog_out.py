"""`--ulog F.ulg`: flights beside what a model says of them, as a log that PX4 Flight Review opens.

Flight Review draws two curves of attitude, rate and place: the estimate, and the ground truth that
a simulation logs. Here the estimate is what the model said `AHEAD` before by commands alone, and
the ground truth is what was measured. Flights follow each other. Units and frames are PX4's: FRD,
NED. Reference: ULog file format, docs.px4.io.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from greybox.commands.flight_series import ahead_of, flight_parameters
from greybox.commands.mcap_out import AHEAD
from greybox.data import Dataset
from greybox.data.channel import command_names, group_names
from greybox.data.readers.assemble import other_frame
from greybox.data.readers.ulog import OURS
from greybox.distribution import VERSION
from greybox.errors import DataError
from greybox.estimation.filtering import Filter
from greybox.files import write_atomic
from greybox.model.identified import IdentifiedModel
from greybox.symbolic import FloatArray
from greybox.validation.adapt import AdaptedRow

PAUSE = 1.0
"""Seconds between two stretches of flight."""
MAV_TYPES = {3: 15, 4: 2, 6: 13, 8: 14}
"""MAVLink's type of a multirotor by its number of rotors."""
_TOPICS = {
    "attitude": ("vehicle_attitude", "FRD/NED"),
    "rate": ("vehicle_angular_velocity", "FRD"),
    "position": ("vehicle_local_position", "NED"),
    "velocity": ("vehicle_local_position", "NED"),
}
"""Channel group -> topic of the estimate, and the frame of its fields."""
_ARRAYS = {"attitude": "q", "rate": "xyz"}
"""Groups whose channels are one field; those of the others are fields of their own."""


class ULog:
    """A ULog file in memory: definitions first, then what was logged, by time."""

    def __init__(self) -> None:
        self._head = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0) + _message("B", bytes(40))
        self._formats: dict[str, str] = {}
        self._definitions: list[bytes] = []
        self._data: list[tuple[int, bytes]] = []

    def info(self, key: str, value: str) -> None:
        """A fact of the log."""
        data = value.encode()
        name = f"char[{len(data)}] {key}".encode()
        self._definitions.append(_message("I", bytes([len(name)]) + name + data))

    def parameter(self, key: str, value: int) -> None:
        """A parameter of the firmware."""
        name = f"int32_t {key}".encode()
        self._definitions.append(
            _message("P", bytes([len(name)]) + name + struct.pack("<i", value))
        )

    def line(self, t: float, text: str) -> None:
        """A logged line of text at a time [s]."""
        stamp = _micro(t)
        self._data.append(
            (stamp, _message("L", b"6" + struct.pack("<Q", stamp) + text.encode()[:2000]))
        )

    def rows(self, topic: str, times: FloatArray, fields: Mapping[str, FloatArray]) -> None:
        """Messages of a topic at times (N,) [s]; a field is (N,), or (N, k) for an array."""
        wide = {
            k: np.asarray(v, dtype=np.float32).reshape(len(times), -1) for k, v in fields.items()
        }
        kinds = [
            f"float[{v.shape[1]}] {k}" if fields[k].ndim == 2 else f"float {k}"
            for k, v in wide.items()
        ]
        text = f"{topic}:uint64_t timestamp;{';'.join(kinds)};"
        if self._formats.setdefault(topic, text) != text:
            raise ValueError(f"{topic} has two formats")
        number = list(self._formats).index(topic)
        for t, row in zip(times, np.hstack(list(wide.values())), strict=True):
            stamp = _micro(t)
            self._data.append(
                (
                    stamp,
                    _message("D", struct.pack("<HQ", number, stamp) + row.astype("<f4").tobytes()),
                )
            )

    def __bytes__(self) -> bytes:
        formats = [_message("F", text.encode()) for text in self._formats.values()]
        # Topics are numbered in the order in which they came.
        named = [
            _message("A", struct.pack("<BH", 0, i) + n.encode())
            for i, n in enumerate(self._formats)
        ]
        data = [d for _, d in sorted(self._data, key=lambda pair: pair[0])]
        return b"".join([self._head, *formats, *self._definitions, *named, *data])


def _message(kind: str, content: bytes) -> bytes:
    return struct.pack("<HB", len(content), ord(kind)) + content


def _micro(t: float) -> int:
    return round(t * 1e6)


def write_ulog(
    path: str | Path,
    model: IdentifiedModel,
    dataset: Dataset,
    *,
    adapted: Mapping[str, Mapping[str, AdaptedRow]] | None = None,
) -> None:
    """All flights of a data set beside what `model` says of them. `adapted` are per-flight values
    by flight."""
    out = ULog()
    for key, value in (
        ("sys_name", OURS),
        ("ver_sw_release_str", VERSION),
        ("ver_hw", "none"),
        ("estimate", f"model, {AHEAD:g} s ahead"),
        ("ground_truth", "measured"),
    ):
        out.info(key, value)
    runner, clock = Filter(model), PAUSE
    for flight in dataset:
        for segment in flight.segments:
            found = runner.run(
                segment, p=flight_parameters(model, (adapted or {}).get(flight.name))
            )
            seconds, ahead = ahead_of(runner, found, AHEAD)
            times = segment.t - segment.t[0] + clock
            out.line(
                clock,
                f"flight {flight.name}: estimate = model {seconds:g} s ahead, ground truth = "
                "measured",
            )
            names = model.dynamics.outputs.names
            _curves(out, "", names, times, ahead)
            _curves(out, "_groundtruth", names, times, found.record.outputs)
            commands = command_names(segment.names)
            if commands:
                motors = np.column_stack([segment.channels[n] for n in commands])
                out.rows("actuator_motors", times, {"control": motors})
            clock = float(times[-1]) + PAUSE
    rotors = len(command_names(dataset.channels))
    if rotors in MAV_TYPES:
        out.parameter("MAV_TYPE", MAV_TYPES[rotors])
    write_atomic(path, bytes(out))


def need_topic(model: IdentifiedModel) -> None:
    """Raises `DataError` where Flight Review has no topic for any output of a model: before any
    work."""
    names = model.dynamics.outputs.names
    if not any(set(group_names(g)) <= set(names) for g in _TOPICS):
        raise DataError(
            "--ulog: Flight Review draws none of this model's outputs",
            expected=f"all channels of one of {', '.join(_TOPICS)}",
            got=", ".join(names),
            fix="leave --ulog out",
        )


def _curves(
    out: ULog, suffix: str, names: Sequence[str], times: FloatArray, values: FloatArray
) -> None:
    """The outputs (N, n_y) of a model that Flight Review has topics for."""
    topics: dict[str, dict[str, FloatArray]] = {}
    for group, (topic, frame) in _TOPICS.items():
        channels = group_names(group)
        if set(channels) <= set(names):
            turned = other_frame(values[:, [names.index(c) for c in channels]], group, frame)
            one = _ARRAYS.get(group)
            fields = {one: turned} if one else dict(zip(channels, turned.T, strict=True))
            topics.setdefault(topic + suffix, {}).update(fields)
    for topic, fields in topics.items():
        out.rows(topic, times, fields)
