"""Mapping file (TOML, schema "greybox.mapping/1"): which fields of a log are which channels, where no reader knows.

    schema = "greybox.mapping/1"
    clock = "/imu"                       # stream whose stamps become the rows; default: that of the body rate

    [time]                               # logs that are one table
    field = "time_ms"
    unit = "ms"

    [rate]                               # one table per group: rate, specific_force, attitude, position, velocity,
    stream = "/imu"                      # command, rotor_speed, battery, setpoint
    fields = ["angular_velocity.x", "-angular_velocity.y", "angular_velocity.z"]
    unit = "deg/s"
    frame = "FRD"

A group without `fields` keeps the reader's own way: `stream` picks among its sources, `delay` and `causal` are set on
the one that is taken; `use = false` leaves the group out.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from greybox.data.channel import GROUPS, group_names
from greybox.data.readers.recording import FRAMES, UNITS, Source
from greybox.errors import DataError, UnknownNameError
from greybox.files import read_toml

SCHEMA = "greybox.mapping/1"
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
TABLE = "table"
"""Name of the only stream of a log that is one table."""

_KEYS = ("stream", "fields", "unit", "frame", "scale", "delay", "limits", "causal", "use")


@dataclass(frozen=True, kw_only=True)
class LogMapping:
    """A mapping file: sources per group, groups left out, clock and time column.

    Of groups that keep the reader's sources, `preferred` names the stream and `changed` the delay and causality.
    """

    sources: Mapping[str, Source] = field(default_factory=dict)
    preferred: Mapping[str, str] = field(default_factory=dict)
    changed: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    unused: frozenset[str] = frozenset()
    clock: str | None = None
    time_field: str | None = None
    time_unit: str | None = None
    where: str = ""


def read_mapping(path: str | os.PathLike[str]) -> LogMapping:
    """Read a mapping file. Raises `DataError` and `UnknownNameError`, which name the file and the key."""
    where = os.fspath(path)
    content = read_toml(path, what="mapping file", error=DataError)
    if content.get("schema") != SCHEMA:
        raise DataError(
            "wrong schema", where=where, expected=SCHEMA, got=repr(content.get("schema")), fix=f'schema = "{SCHEMA}"'
        )
    allowed = ("schema", "clock", "time", *GROUPS)
    for key in content:
        if key not in allowed:
            raise UnknownNameError("key", key, allowed, where=where)
    time = _table(content, "time", ("field", "unit"), where)
    unit = _text(time, "unit", f"{where}: time", None)
    if unit is not None and unit not in TIME_UNITS:
        raise UnknownNameError("unit", unit, TIME_UNITS, where=f"{where}: time.unit")
    sources: dict[str, Source] = {}
    preferred: dict[str, str] = {}
    changed: dict[str, dict[str, Any]] = {}
    unused = set()
    for group in GROUPS:
        if group not in content:
            continue
        table = _table(content, group, _KEYS, where)
        place = f"{where}: {group}"
        if not _boolean(table, "use", place, True):
            unused.add(group)
        elif "fields" in table:
            sources[group] = _source(group, table, place)
        elif table and set(table) <= {"stream", "use", "delay", "causal"}:
            if "stream" in table:
                preferred[group] = str(_text(table, "stream", place, None))
            if "delay" in table:
                changed.setdefault(group, {})["delay"] = _number(table["delay"], f"{place}.delay")
            if "causal" in table:
                changed.setdefault(group, {})["causal"] = _boolean(table, "causal", place, True)
        else:
            raise DataError("no fields", where=place, expected="the fields in the order of the channels",
                            fix=f"fields = [...]  # {', '.join(group_names(group))}")  # fmt: skip
    return LogMapping(
        sources=sources,
        preferred=preferred,
        changed=changed,
        unused=frozenset(unused),
        clock=_text(content, "clock", where, None),
        time_field=_text(time, "field", f"{where}: time", None),
        time_unit=unit,
        where=where,
    )


def _source(group: str, table: Mapping[str, Any], where: str) -> Source:
    fields = table["fields"]
    if not (isinstance(fields, list) and fields and all(isinstance(f, str) and f.strip("-") for f in fields)):
        raise DataError("fields", where=where, expected="a list of names in quotes", got=repr(fields)[:60])
    angles = group == "attitude" and len(fields) == 3
    count = len(group_names(group))
    if group in ("command", "rotor_speed"):
        if len(fields) > 99:
            raise DataError(f"{len(fields)} fields", where=where, expected="one per rotor")
    elif len(fields) != count and not angles:
        also = ", or roll, pitch, yaw" if group == "attitude" else ""
        raise DataError(
            f"{len(fields)} fields", where=where, expected=f"{count}: {', '.join(group_names(group))}{also}"
        )
    unit = _text(table, "unit", where, "rad" if angles else "")
    known = [u for u in UNITS[group] if (u != "1") == angles or group != "attitude"]
    if unit and unit not in known:
        raise UnknownNameError("unit", unit, known, where=f"{where}.unit")
    frame = _text(table, "frame", where, "")
    if frame and frame not in FRAMES.get(group, ()):
        raise UnknownNameError("frame", frame, FRAMES.get(group, ()), where=f"{where}.frame")
    limits = table.get("limits")
    if limits is not None:
        if group != "command" or not (isinstance(limits, list) and len(limits) == 2):
            raise DataError("limits", where=where, expected="[low, high] of a command", got=repr(limits)[:60])
        limits = (_number(limits[0], f"{where}.limits"), _number(limits[1], f"{where}.limits"))
        if not limits[1] > limits[0]:
            raise DataError("limits", where=where, expected="low < high", got=f"{limits[0]:g}, {limits[1]:g}")
    return Source(
        group=group,
        stream=str(_text(table, "stream", where, TABLE)),
        fields=tuple(fields),
        unit=str(unit),
        frame=str(frame),
        scale=_number(table.get("scale", 1.0), f"{where}.scale"),
        delay=_number(table.get("delay", 0.0), f"{where}.delay"),
        limits=limits,
        causal=_boolean(table, "causal", where, True),
        note=f"as {os.path.basename(where.partition(': ')[0])} says",
    )


def _table(content: Mapping[str, Any], key: str, known: tuple[str, ...], where: str) -> dict[str, Any]:
    table = content.get(key, {})
    if not isinstance(table, dict):
        raise DataError(f"'{key}' is not a table", where=where, fix=f"write [{key}]")
    for name in table:
        if name not in known:
            raise UnknownNameError("key", name, known, where=f"{where}: {key}")
    return table


def _text(table: Mapping[str, Any], key: str, where: str, default: str | None) -> str | None:
    value = table.get(key, default)
    if value is not None and not isinstance(value, str):
        raise DataError(f"'{key}' is not a text", where=where, got=repr(value)[:60], fix="put it in quotes")
    return value


def _boolean(table: Mapping[str, Any], key: str, where: str, default: bool) -> bool:
    value = table.get(key, default)
    if not isinstance(value, bool):
        raise DataError(f"'{key}' is not a boolean", where=where, got=repr(value)[:60], fix="write true or false")
    return value


def _number(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise DataError("a finite number is needed here", where=where, got=repr(value)[:60])
    return float(value)
