"""`--mcap F.mcap`: flights beside what a model says of them, for Foxglove, Rerun and PlotJuggler.

Poses, paths and lines of a log follow the JSON schemas of Foxglove (https://docs.foxglove.dev/docs/sdk/schemas);
innovations, forces and torques are plain numbers, each with a schema of its own. One channel per flight and
kind, /FLIGHT/KIND.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from greybox.commands.flight_series import POSE, ahead_of, flight_parameters
from greybox.data import Dataset, Segment
from greybox.distribution import VERSION
from greybox.estimation.filtering import Filter, Filtered
from greybox.estimation.smoothing import smooth
from greybox.files import write_atomic
from greybox.symbolic import FloatArray

AHEAD = 0.5
"""Seconds that `ahead` looks ahead, as the curves of a page."""
BAND = 1.96
"""Half width of the band of force and torque in standard deviations: 95 % of a normal distribution."""
WORLD, CRAFT = "world", "craft"

_TIME = {
    "type": "object", "title": "time",
    "properties": {"sec": {"type": "integer", "minimum": 0},
                   "nsec": {"type": "integer", "minimum": 0, "maximum": 999_999_999}},
    "required": ["sec", "nsec"],
}  # fmt: skip


def _numbers(title: str, names: Sequence[str], kind: Any = "number") -> dict[str, Any]:
    return {"type": "object", "title": title, "properties": {n: {"type": kind} for n in names}, "required": list(names)}


def _stamped(title: str, **properties: Any) -> dict[str, Any]:
    all_ = {"timestamp": _TIME, **properties}
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": title, "type": "object",
            "properties": all_, "required": list(all_)}  # fmt: skip


_VECTOR, _QUATERNION = _numbers("foxglove.Vector3", "xyz"), _numbers("foxglove.Quaternion", "xyzw")
_POSE = {
    "type": "object", "title": "foxglove.Pose",
    "properties": {"position": _VECTOR, "orientation": _QUATERNION}, "required": ["position", "orientation"],
}  # fmt: skip
SCHEMAS: Mapping[str, Mapping[str, Any]] = {
    "foxglove.PoseInFrame": _stamped("foxglove.PoseInFrame", frame_id={"type": "string"}, pose=_POSE),
    "foxglove.PosesInFrame": _stamped(
        "foxglove.PosesInFrame", frame_id={"type": "string"}, poses={"type": "array", "items": _POSE}
    ),
    "foxglove.FrameTransform": _stamped(
        "foxglove.FrameTransform", parent_frame_id={"type": "string"}, child_frame_id={"type": "string"},
        translation=_VECTOR, rotation=_QUATERNION,
    ),
    "foxglove.Log": _stamped(
        "foxglove.Log", level={"type": "integer", "minimum": 0, "maximum": 5}, message={"type": "string"},
        name={"type": "string"}, file={"type": "string"}, line={"type": "integer", "minimum": 0},
    ),
}  # fmt: skip
"""By name, as far as they are written here: every field of these is required."""
INFO, WARNING = 2, 3


class Recording:
    """An MCAP file that is being written; it appears under its name when it is whole."""

    def __init__(self, writer: Any) -> None:
        self._writer = writer
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._count: dict[str, int] = {}

    def message(
        self, topic: str, schema: str, t: float, content: Mapping[str, Any], own: Mapping[str, Any] | None = None
    ) -> None:
        """One message of a channel at `t` [s]; `own` is the schema where it is not one of `SCHEMAS`."""
        if topic not in self._channels:
            if schema not in self._schemas:
                text = json.dumps(own or SCHEMAS[schema]).encode()
                self._schemas[schema] = self._writer.register_schema(name=schema, encoding="jsonschema", data=text)
            self._channels[topic] = self._writer.register_channel(
                topic=topic, message_encoding="json", schema_id=self._schemas[schema]
            )
        nanoseconds = round(t * 1e9)
        stamp = {"sec": nanoseconds // 10**9, "nsec": nanoseconds % 10**9}
        sequence = self._count[topic] = self._count.get(topic, -1) + 1
        self._writer.add_message(
            channel_id=self._channels[topic], log_time=nanoseconds, publish_time=nanoseconds, sequence=sequence,
            data=json.dumps({"timestamp": stamp, **content}, allow_nan=False).encode(),
        )  # fmt: skip

    def log(self, topic: str, t: float, text: str, *, level: int = INFO) -> None:
        """A line of text at a time."""
        self.message(topic, "foxglove.Log", t, {"level": level, "message": text, "name": "greybox", "file": "", "line": 0})


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


def write_mcap(path: str | Path, model: Any, *datasets: Dataset, adapted: Mapping[str, Any] | None = None) -> None:
    """All flights of the data sets beside what `model` says of them. `adapted` are per-flight values by flight."""
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
                found = runner.run(segment, p=flight_parameters(model, (adapted or {}).get(flight.name)))
                _segment(out, root, runner, found, segment, shift)


def _segment(out: Recording, root: str, runner: Filter, found: Filtered, segment: Segment, shift: float) -> None:
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
                    pose = _pose(row)
                    path.append(pose)
                    out.message(f"{root}/{kind}/pose", "foxglove.PoseInFrame", t, {"frame_id": WORLD, "pose": pose})
                    if kind == "measured":
                        place = {"parent_frame_id": WORLD, "child_frame_id": f"{CRAFT} {root[1:]}",
                                 "translation": pose["position"], "rotation": pose["orientation"]}  # fmt: skip
                        out.message("/tf", "foxglove.FrameTransform", t, place)
            if path:
                thin = path[:: max(1, len(path) // 500)]
                out.message(f"{root}/{kind}/path", "foxglove.PosesInFrame", times[0], {"frame_id": WORLD, "poses": thin})
    labels = dynamics.innovations.names
    own = _stamped(
        "greybox.Innovations",
        value=_numbers("innovations", labels, ["number", "null"]), std=_numbers("standard deviations", labels),
    )  # fmt: skip
    there = found.record.mask > 0
    for t, e, s, seen in zip(times, found.innovations, found.sigma, there):
        value = {n: float(v) if ok else None for n, v, ok in zip(labels, e, seen)}
        content = {"value": value, "std": {n: float(v) for n, v in zip(labels, s)}}
        out.message(f"{root}/innovations", f"greybox.Innovations {' '.join(labels)}", t, content, own)
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
        axes = [chosen[i].split(".", 2)[-1] for i in at]
        own = _stamped(f"greybox.Push {kind}", **{k: _numbers(k, axes) for k in ("value", "low", "high")})
        for t, v, h in zip(times, value[:, at], half[:, at]):
            rows = {"value": v, "low": v - h, "high": v + h}
            content = {k: dict(zip(axes, map(float, r))) for k, r in rows.items()}
            out.message(f"{root}/{kind}", f"greybox.Push {kind}", t, content, own)


def _pose(row: FloatArray) -> dict[str, dict[str, float]]:
    """A pose of Foxglove from (x, y, z, qw, qx, qy, qz)."""
    x, y, z, *q = (float(v) for v in row)
    size = math.hypot(*q) or 1.0
    w, a, b, c = (v / size for v in q)
    return {"position": {"x": x, "y": y, "z": z}, "orientation": {"x": a, "y": b, "z": c, "w": w}}
