"""`--mcap F.mcap`: flights beside what a model says of them, for Foxglove, Rerun and PlotJuggler.

Poses, paths and lines of a log are messages of Foxglove
(https://docs.foxglove.dev/docs/sdk/schemas), as protocol buffers: Rerun and PlotJuggler take those
apart, and leave JSON as bytes. Innovations, forces and torques are plain numbers, each in a type of
its own. One channel per flight and kind, /FLIGHT/KIND.
"""

from __future__ import annotations

import contextlib
import io
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from greybox.commands.flight_series import POSE, ahead_of, flight_parameters
from greybox.data import Dataset, Segment
from greybox.data.readers.protobuf import Enums, Field, Types, describe, encode, fields
from greybox.distribution import VERSION
from greybox.estimation.filtering import Filter, Filtered
from greybox.estimation.smoothing import smooth
from greybox.files import write_atomic
from greybox.model.identified import IdentifiedModel
from greybox.symbolic import FloatArray
from greybox.validation.adapt import AdaptedRow

if TYPE_CHECKING:
    from mcap.writer import Writer

AHEAD = 0.5
"""Seconds that `ahead` looks ahead, as the curves of a page."""
BAND = 1.96
"""Half width of the band of force and torque in standard deviations: 95 % of a normal
distribution."""
WORLD = "world"
Pose: TypeAlias = Mapping[str, Mapping[str, float]]
"""Position and orientation by their components."""


def _message(name: str, of: str, number: int, *, many: bool = False) -> Field:
    return Field(name=name, number=number, kind="message", of=of, many=many)


_STAMP = _message("timestamp", "google.protobuf.Timestamp", 1)
TYPES: Types = {
    "google.protobuf.Timestamp": fields(("seconds", "int64"), ("nanos", "int32")),
    "foxglove.Vector3": fields(*"xyz"),
    "foxglove.Quaternion": fields(*"xyzw"),
    "foxglove.Pose": (
        _message("position", "foxglove.Vector3", 1),
        _message("orientation", "foxglove.Quaternion", 2),
    ),
    "foxglove.PoseInFrame": fields(
        _STAMP, ("frame_id", "string"), ("pose", "message", "foxglove.Pose")
    ),
    "foxglove.PosesInFrame": fields(
        _STAMP, ("frame_id", "string"), _message("poses", "foxglove.Pose", 3, many=True)
    ),
    "foxglove.FrameTransform": fields(
        _STAMP,
        ("parent_frame_id", "string"),
        ("child_frame_id", "string"),
        ("translation", "message", "foxglove.Vector3"),
        ("rotation", "message", "foxglove.Quaternion"),
    ),
    "foxglove.Log": fields(
        _STAMP,
        ("level", "enum", "foxglove.Log.Level"),
        ("message", "string"),
        ("name", "string"),
        ("file", "string"),
        ("line", "fixed32"),
    ),
}
"""Message types by full name, with Foxglove's own numbers."""
ENUMS: Enums = {
    "foxglove.Log.Level": {
        "UNKNOWN": 0,
        "DEBUG": 1,
        "INFO": 2,
        "WARNING": 3,
        "ERROR": 4,
        "FATAL": 5,
    }
}


def rows_of(title: str, kinds: Sequence[str], labels: Sequence[str]) -> dict[str, Sequence[Field]]:
    """A stamped message type of ours, with a part per kind that has a number per label."""
    part = f"{title}Values"
    own = (_STAMP, *(_message(k, part, i) for i, k in enumerate(kinds, start=2)))
    return {title: own, part: fields(*labels)}


def plain_names(labels: Sequence[str]) -> list[str]:
    """Labels as names of fields: letters, digits and _, each once."""
    out: list[str] = []
    for label in labels:
        name = re.sub(r"\W", "_", label, flags=re.ASCII)
        name = f"_{name}" if name[:1].isdigit() or not name else name
        while name in out:
            name += "_"
        out.append(name)
    return out


INFO, WARNING = 2, 3


class Recording:
    """An MCAP file that is being written; it appears under its name when it is whole."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._types: dict[str, Sequence[Field]] = dict(TYPES)
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._count: dict[str, int] = {}

    def declare(self, types: Types) -> None:
        """Take message types besides `TYPES`, before their first message."""
        self._types.update(types)

    def message(self, topic: str, kind: str, t: float, content: Mapping[str, object]) -> None:
        """One message of a channel at `t` [s], without its stamp; `kind` is the full name of its
        type."""
        if topic not in self._channels:
            if kind not in self._schemas:
                text = describe(self._types, kind, ENUMS)
                self._schemas[kind] = self._writer.register_schema(
                    name=kind, encoding="protobuf", data=text
                )
            self._channels[topic] = self._writer.register_channel(
                topic=topic, message_encoding="protobuf", schema_id=self._schemas[kind]
            )
        nanoseconds = round(t * 1e9)
        stamp = {"seconds": nanoseconds // 10**9, "nanos": nanoseconds % 10**9}
        sequence = self._count[topic] = self._count.get(topic, -1) + 1
        self._writer.add_message(
            channel_id=self._channels[topic],
            log_time=nanoseconds,
            publish_time=nanoseconds,
            sequence=sequence,
            data=encode(self._types, kind, {"timestamp": stamp, **content}),
        )

    def pose(self, root: str, t: float, pose: Pose, *, craft: str) -> None:
        """A pose at a time, and the same as the frame `craft`, which a 3D view moves."""
        self.message(f"{root}/pose", "foxglove.PoseInFrame", t, {"frame_id": WORLD, "pose": pose})
        place = {
            "parent_frame_id": WORLD,
            "child_frame_id": craft,
            "translation": pose["position"],
            "rotation": pose["orientation"],
        }
        self.message(f"{root}/tf", "foxglove.FrameTransform", t, place)

    def log(self, topic: str, t: float, text: str, *, level: int = INFO) -> None:
        """A line of text at a time."""
        self.message(
            topic,
            "foxglove.Log",
            t,
            {"level": level, "message": text, "name": "greybox", "file": "", "line": 0},
        )


@contextlib.contextmanager
def recording(path: str | Path) -> Iterator[Recording]:
    """Collect a recording and write it when it is whole."""
    from mcap.writer import Writer

    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start(profile="", library=f"greybox {VERSION}")
    yield Recording(writer)
    writer.finish()
    write_atomic(path, stream.getvalue())


def write_mcap(
    path: str | Path,
    model: IdentifiedModel,
    *datasets: Dataset,
    adapted: Mapping[str, Mapping[str, AdaptedRow]] | None = None,
) -> None:
    """All flights of the data sets beside what `model` says of them. `adapted` are per-flight
    values by flight."""
    runner = Filter(model)
    with recording(path) as out:
        flights = [f for data in datasets for f in data]
        # Stamps of a recording begin at zero or later.
        shift = max(0.0, -min((float(s.t[0]) for f in flights for s in f.segments), default=0.0))
        for flight in flights:
            root = f"/{flight.name}"
            first = shift + float(flight.segments[0].t[0])
            for note in flight.notes:
                out.log(f"{root}/events", first, note)
            for removed in flight.removed:
                out.log(f"{root}/events", first, removed.line(), level=WARNING)
            for i, segment in enumerate(flight.segments):
                if i:
                    gap = float(segment.t[0] - flight.segments[i - 1].t[-1])
                    text = f"nothing usable for {gap:.2f} s before this"
                    out.log(f"{root}/events", shift + float(segment.t[0]), text, level=WARNING)
                found = runner.run(
                    segment, p=flight_parameters(model, (adapted or {}).get(flight.name))
                )
                _segment(out, root, runner, found, segment, shift)


def _segment(
    out: Recording, root: str, runner: Filter, found: Filtered, segment: Segment, shift: float
) -> None:
    dynamics = runner.model.dynamics
    names = dynamics.outputs.names
    times = segment.t + shift
    if set(POSE) <= set(names):
        columns = [names.index(n) for n in POSE]
        _, ahead = ahead_of(runner, found, AHEAD)
        poses = {"measured": found.record.outputs, "one_step_ahead": found.outputs, "ahead": ahead}
        for kind, rows in poses.items():
            path = []
            for t, row in zip(times, rows[:, columns]):
                if np.isfinite(row).all():
                    pose = pose_of(row)
                    path.append(pose)
                    out.pose(f"{root}/{kind}", t, pose, craft=f"{root[1:]} {kind}")
            if path:
                thin = path[:: max(1, len(path) // 500)]
                out.message(
                    f"{root}/{kind}/path",
                    "foxglove.PosesInFrame",
                    times[0],
                    {"frame_id": WORLD, "poses": thin},
                )
    labels = dynamics.innovations.names
    fields_of = plain_names(labels)
    out.declare(rows_of("greybox.Innovations", ("value", "std"), fields_of))
    # A measurement that is missing is not a number.
    innovations = np.where(found.record.mask > 0, found.innovations, np.nan)
    for t, e, s in zip(times, innovations, found.sigma):
        content = {"value": dict(zip(fields_of, e)), "std": dict(zip(fields_of, s))}
        out.message(f"{root}/innovations", "greybox.Innovations", t, content)
    _pushes(out, root, runner, found, times)


def _pushes(out: Recording, root: str, runner: Filter, found: Filtered, times: FloatArray) -> None:
    """Smoothed force and torque with their bands, of a model that has disturbance states."""
    dynamics = runner.model.dynamics
    spread = {n.removeprefix("d_"): i for i, n in enumerate(dynamics.error_states.names)}
    chosen = [n for n in dynamics.states.names if n.startswith("disturbance.") and n in spread]
    if not chosen:
        return
    smoothed = smooth(runner, found)
    value = smoothed.states[:, [dynamics.states.names.index(n) for n in chosen]]
    half = BAND * np.sqrt(smoothed.variance[:, [spread[n] for n in chosen]])
    for kind in dict.fromkeys(n.split(".")[1] for n in chosen):
        at = [i for i, n in enumerate(chosen) if n.split(".")[1] == kind]
        axes = plain_names([chosen[i].split(".", 2)[-1] for i in at])
        title = f"greybox.{kind.capitalize()}"
        out.declare(rows_of(title, ("value", "low", "high"), axes))
        for t, v, h in zip(times, value[:, at], half[:, at]):
            rows = {"value": v, "low": v - h, "high": v + h}
            content = {k: dict(zip(axes, r)) for k, r in rows.items()}
            out.message(f"{root}/{kind}", title, t, content)


def pose_of(row: Sequence[float] | FloatArray) -> Pose:
    """A pose of Foxglove from (x, y, z, qw, qx, qy, qz)."""
    x, y, z, *q = (float(v) for v in row)
    size = math.hypot(*q) or 1.0
    w, a, b, c = (v / size for v in q)
    return {"position": {"x": x, "y": y, "z": z}, "orientation": {"x": a, "y": b, "z": c, "w": w}}
