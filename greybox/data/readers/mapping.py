"""The dialect of columns: which fields of a log are which channels, where no reader knows.

It is spoken in a mapping file (TOML, schema "greybox.mapping/1") and in the table `[columns]` of a
vehicle file, where `[rate]` is called `[columns.rate]`. A mapping file must fit its logs; a vehicle
file may name what some logs lack.

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

A group without `fields` keeps those of the vehicle file, else the reader's own way: `stream` picks
among its sources, `delay` and `causal` are set on the one that is taken; `use = false` leaves the
group out.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypedDict, TypeVar

from greybox.data.channel import GROUPS, group_names
from greybox.data.readers.recording import FRAMES, UNITS, Source
from greybox.errors import DataError, UnknownNameError
from greybox.files import OTHER_VERSION, Json, of_another_version, read_toml

SCHEMA = "greybox.mapping/1"
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
TABLE = "table"
"""Name of the only stream of a log that is one table."""

_TIME_KEYS = ("field", "unit", "scale", "offset")
_KEYS = (
    *("stream", "fields", "unit", "frame", "scale", "offset"),
    *("delay", "limits", "gravity", "causal", "use"),
)
_PER_ROTOR = ("command", "rotor_speed")


T = TypeVar("T")


class Changed(TypedDict, total=False):
    """What a mapping changes of a source that the reader keeps."""

    delay: float
    causal: bool


@dataclass(frozen=True, kw_only=True)
class LogMapping:
    """Sources per group, groups left out, clock and time column, of one file.

    Of groups that keep the reader's sources, `preferred` names the stream and `changed` the delay
    and causality. A log may lack what the groups (and "clock", "time") of `optional` name. The time
    [s] is `time_scale` (None: 1) times its column plus `time_offset` (None: 0).
    """

    sources: Mapping[str, Source] = field(default_factory=dict)
    preferred: Mapping[str, str] = field(default_factory=dict)
    changed: Mapping[str, Changed] = field(default_factory=dict)
    unused: frozenset[str] = frozenset()
    optional: frozenset[str] = frozenset()
    clock: str | None = None
    time_field: str | None = None
    time_unit: str | None = None
    time_scale: float | None = None
    time_offset: float | None = None
    where: str = field(default="", compare=False)

    def __bool__(self) -> bool:
        """Whether it says anything."""
        return self != LogMapping()

    @property
    def groups(self) -> frozenset[str]:
        """The groups that it says something of."""
        return frozenset({*self.sources, *self.preferred, *self.changed, *self.unused})

    @property
    def names(self) -> frozenset[str]:
        """Columns of a log that is one table, as far as they are named."""
        fields = {
            f.lstrip("-") for s in self.sources.values() if s.stream == TABLE for f in s.fields
        }
        return frozenset(fields | {self.time_field or ""}) - {""}

    def over(self, other: LogMapping) -> LogMapping:
        """This mapping, and of `other` what it leaves open.

        Fields, a time column or a unit of the time of its own take nothing that `other` says of
        another one.
        """
        mine = self.groups
        kept = frozenset(g for g in mine if self._refines(other, g))

        def rest(theirs: Mapping[str, T]) -> dict[str, T]:
            return {k: v for k, v in theirs.items() if k not in mine or k in kept}

        sources = {
            g: replace(s, **self.changed.get(g, Changed())) for g, s in rest(other.sources).items()
        }
        changed: dict[str, Changed] = {
            g: {**rest(other.changed).get(g, Changed()), **c} for g, c in self.changed.items()
        }
        own = (
            frozenset(sources) & kept
        )  # their groups have fields, so that nothing is left to the reader
        time = self._time_over(other)
        stated = (
            mine | ({"clock"} if self.clock else set()) | ({"time"} if self._says_time else set())
        )
        return LogMapping(
            sources={**sources, **self.sources},
            preferred={
                g: s for g, s in {**rest(other.preferred), **self.preferred}.items() if g not in own
            },
            changed={g: c for g, c in {**rest(other.changed), **changed}.items() if g not in own},
            unused=self.unused | (other.unused - mine),
            optional=self.optional | (other.optional - stated),
            clock=self.clock or other.clock,
            time_field=time.time_field,
            time_unit=time.time_unit,
            time_scale=time.time_scale,
            time_offset=time.time_offset,
            where=self.where or other.where,
        )

    def _refines(self, other: LogMapping, group: str) -> bool:
        """Whether what is said of a group goes with what `other` says: no fields and no other
        stream."""
        if group in self.sources or group in self.unused:
            return False
        source = other.sources.get(group)
        theirs = source.stream if source is not None else other.preferred.get(group)
        return theirs is None or self.preferred.get(group) in (None, theirs)

    @property
    def _says_time(self) -> bool:
        return any(
            v is not None
            for v in (self.time_field, self.time_unit, self.time_scale, self.time_offset)
        )

    def _time_over(self, other: LogMapping) -> LogMapping:
        """The time as this mapping and then `other` say it."""
        if self.time_field not in (None, other.time_field):
            return self
        scale = (
            self.time_scale if self.time_scale is not None or self.time_unit else other.time_scale
        )
        return LogMapping(
            time_field=other.time_field,
            time_unit=self.time_unit or other.time_unit,
            time_scale=scale,
            time_offset=other.time_offset if self.time_offset is None else self.time_offset,
        )

    def to_dict(self) -> dict[str, Json]:
        """The tables of its file, as plain values."""
        out: dict[str, Json] = {} if self.clock is None else {"clock": self.clock}
        time = {
            "field": self.time_field,
            "unit": self.time_unit,
            "scale": self.time_scale,
            "offset": self.time_offset,
        }
        if time := {k: v for k, v in time.items() if v is not None}:
            out["time"] = time
        for group in GROUPS:
            if group in self.unused:
                out[group] = {"use": False}
            elif group in self.sources:
                out[group] = _entry(self.sources[group])
            elif group in self.groups:
                said: dict[str, Json] = {}
                if group in self.preferred:
                    said["stream"] = self.preferred[group]
                changed = self.changed.get(group, Changed())
                if "delay" in changed:
                    said["delay"] = changed["delay"]
                if "causal" in changed:
                    said["causal"] = changed["causal"]
                out[group] = said
        return out


_DEFAULTS: Mapping[str, object] = {
    "stream": TABLE,
    "unit": "",
    "frame": "",
    "scale": 1.0,
    "offset": 0.0,
    "delay": 0.0,
    "limits": None,
    "gravity": True,
    "causal": True,
}


def _entry(source: Source) -> dict[str, Json]:
    """The table of a group, without what goes without saying."""
    said: dict[str, Json] = {"fields": source.fields, "stream": source.stream, "unit": source.unit}
    said |= {
        "frame": source.frame,
        "scale": source.scale,
        "offset": source.offset,
        "delay": source.delay,
    }
    said |= {"limits": source.limits, "gravity": source.gravity, "causal": source.causal}
    kept = {k: v for k, v in said.items() if k == "fields" or v != _DEFAULTS[k]}
    return {k: list(v) if isinstance(v, tuple) else v for k, v in kept.items()}


def mapping_text(
    content: Mapping[str, Json], *, prefix: str = "", comments: Mapping[str, str] | None = None
) -> str:
    """`LogMapping.to_dict` as TOML, tables called `prefix` + group, a comment behind the last line
    of a group."""
    lines = [f"{k} = {_toml(v)}" for k, v in content.items() if not isinstance(v, Mapping)]
    for name, table in content.items():
        if isinstance(table, Mapping):
            lines += [f"[{prefix}{name}]", *(f"{k} = {_toml(v)}" for k, v in table.items())]
            lines[-1] += f"  # {said}" if (said := (comments or {}).get(name)) else ""
    return "\n".join(lines) + "\n"


def _toml(value: Json) -> str:
    """A value of TOML, whose strings have no surrogates and no bare DEL."""
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007F")
    if isinstance(value, Sequence):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, bool):
        return str(value).lower()
    if value is None or isinstance(value, Mapping):
        raise TypeError(f"{value!r} is no value of TOML")
    return f"{value:.0f}" if float(value).is_integer() and abs(value) < 1e15 else repr(value)


def read_mapping(path: str | os.PathLike[str]) -> LogMapping:
    """Read a mapping file. Raises `DataError` and `UnknownNameError`, which name the file and the
    key."""
    where = os.fspath(path)
    content = read_toml(path, what="mapping file", error=DataError)
    if content.get("schema") != SCHEMA:
        raise DataError(
            OTHER_VERSION if of_another_version(content.get("schema"), SCHEMA) else "wrong schema",
            where=where,
            expected=SCHEMA,
            got=repr(content.get("schema")),
            fix=f'schema = "{SCHEMA}"',
        )
    return mapping_of({k: v for k, v in content.items() if k != "schema"}, where=where)


def mapping_of(content: Mapping[str, object], *, where: str, path: str = "") -> LogMapping:
    """The mapping that the tables of a file say; `path` is the dotted key of the table that holds
    them.

    Raises `DataError` and `UnknownNameError`, which name the file and the key.
    """
    allowed = ("clock", "time", *GROUPS)
    for key in content:
        if key not in allowed:
            raise UnknownNameError("key", key, allowed, where=f"{where}: {path}" if path else where)
    dot = f"{path}." if path else ""
    time = _table(content, "time", _TIME_KEYS, where, dot)
    place = f"{where}: {dot}time"
    unit = _text(time, "unit", place, None)
    if unit is not None and unit not in TIME_UNITS:
        raise UnknownNameError("unit", unit, TIME_UNITS, where=f"{place}.unit")
    said = LogMapping(
        clock=_text(content, "clock", where, None),
        time_field=_text(time, "field", place, None),
        time_unit=unit,
        time_scale=_factor(_number(time["scale"], f"{place}.scale"), f"{place}.scale")
        if "scale" in time
        else None,
        time_offset=_number(time["offset"], f"{place}.offset") if "offset" in time else None,
        where=where,
    )
    for group in GROUPS:
        if group in content:
            said = _with_group(
                said, group, _table(content, group, _KEYS, where, dot), f"{where}: {dot}{group}"
            )
    _no_field_twice(said, where)
    return said


def _with_group(
    said: LogMapping, group: str, table: Mapping[str, object], place: str
) -> LogMapping:
    """The mapping with what the table of one more group says."""
    if not _boolean(table, "use", place, True):
        return replace(said, unused=said.unused | {group})
    if "fields" in table:
        return replace(said, sources={**said.sources, group: _source(group, table, place)})
    if not table or not set(table) <= {"stream", "use", "delay", "causal"}:
        raise DataError(
            "no fields",
            where=place,
            expected="the fields in the order of the channels",
            fix=f"fields = [...]  # {', '.join(group_names(group))}",
        )
    changed: Changed = {}
    if "delay" in table:
        changed["delay"] = _number(table["delay"], f"{place}.delay")
    if "causal" in table:
        changed["causal"] = _boolean(table, "causal", place, True)
    if changed:
        said = replace(said, changed={**said.changed, group: changed})
    if "stream" in table:
        said = replace(
            said, preferred={**said.preferred, group: str(_text(table, "stream", place, None))}
        )
    return said


def _no_field_twice(said: LogMapping, where: str) -> None:
    taken: dict[tuple[str, str], str] = (
        {(TABLE, said.time_field): "time"} if said.time_field else {}
    )
    for group, source in said.sources.items():
        for name in source.fields:
            key = (source.stream, name.lstrip("-"))
            if name and key in taken:
                raise DataError(
                    f"column '{key[1]}' is given to two channels",
                    where=f"{where}: {group}",
                    fix=f"name another column; it stands in {taken[key]} too",
                )
            taken[key] = group


def _source(group: str, table: Mapping[str, object], where: str) -> Source:
    fields = table["fields"]
    if (
        not isinstance(fields, list)
        or not any(fields)
        or not all(isinstance(f, str) and (not f or f.strip("-")) for f in fields)
    ):
        raise DataError(
            "fields", where=where, expected="a list of names in quotes", got=repr(fields)[:60]
        )
    angles = group == "attitude" and len(fields) == 3
    count = len(group_names(group))
    if group in _PER_ROTOR:
        if len(fields) > 99:
            raise DataError(f"{len(fields)} fields", where=where, expected="one per rotor")
    elif len(fields) != count and not (group == "attitude" and len(fields) in (3, 9)):
        turns = ", or roll, pitch, yaw, or a rotation matrix row by row"
        also = turns if group == "attitude" else ""
        raise DataError(
            f"{len(fields)} fields",
            where=where,
            expected=f"{count}: {', '.join(group_names(group))}{also}",
        )
    unit = _text(table, "unit", where, "rad" if angles else "")
    known = [u for u in UNITS[group] if (u != "1") == angles or group != "attitude"]
    if unit and unit not in known:
        raise UnknownNameError("unit", unit, known, where=f"{where}.unit")
    frame = _text(table, "frame", where, "")
    if frame and frame not in FRAMES.get(group, ()):
        raise UnknownNameError("frame", frame, FRAMES.get(group, ()), where=f"{where}.frame")
    return Source(
        group=group,
        stream=str(_text(table, "stream", where, TABLE)),
        fields=tuple(fields),
        unit=str(unit),
        frame=str(frame),
        scale=_each(table, "scale", 1.0, len(fields), where, _factor),
        offset=_each(table, "offset", 0.0, len(fields), where, lambda value, place: value),
        delay=_number(table.get("delay", 0.0), f"{where}.delay"),
        limits=_limits(group, table, where),
        gravity=_gravity(group, table, where),
        causal=_boolean(table, "causal", where, True),
        note=f"as {os.path.basename(where.partition(': ')[0])} says",
    )


def _gravity(group: str, table: Mapping[str, object], where: str) -> bool:
    if "gravity" in table and group != "specific_force":
        raise DataError(
            "'gravity' is said of a specific force alone", where=where, fix="drop the key"
        )
    return _boolean(table, "gravity", where, True)


def _limits(group: str, table: Mapping[str, object], where: str) -> tuple[float, float] | None:
    limits = table.get("limits")
    if limits is None:
        return None
    if group != "command" or not (isinstance(limits, list) and len(limits) == 2):
        raise DataError(
            "limits", where=where, expected="[low, high] of a command", got=repr(limits)[:60]
        )
    low, high = (_number(v, f"{where}.limits") for v in limits)
    if not high > low:
        raise DataError("limits", where=where, expected="low < high", got=f"{low:g}, {high:g}")
    return low, high


def _each(
    table: Mapping[str, object],
    key: str,
    default: float,
    count: int,
    where: str,
    checked: Callable[[float, str], float],
) -> float | tuple[float, ...]:
    """A number for all fields, or a list with one for each."""
    value, place = table.get(key, default), f"{where}.{key}"
    if not isinstance(value, list):
        return checked(_number(value, place), place)
    if len(value) != count:
        raise DataError(
            f"{len(value)} numbers", where=place, expected=f"one, or one for each of {count} fields"
        )
    return tuple(checked(_number(v, place), place) for v in value)


def _factor(value: float, where: str) -> float:
    if value == 0.0:
        raise DataError(
            "must not be zero", where=where, fix="give the factor from the log's unit to SI"
        )
    return value


def _table(
    content: Mapping[str, object], key: str, known: tuple[str, ...], where: str, dot: str
) -> Mapping[str, object]:
    table = content.get(key, {})
    if not isinstance(table, Mapping):
        raise DataError(f"'{dot}{key}' is not a table", where=where, fix=f"write [{dot}{key}]")
    for name in table:
        if name not in known:
            raise UnknownNameError("key", name, known, where=f"{where}: {dot}{key}")
    return table


def _text(table: Mapping[str, object], key: str, where: str, default: str | None) -> str | None:
    value = table.get(key, default)
    if value is not None and not isinstance(value, str):
        raise DataError(
            f"'{key}' is not a text", where=where, got=repr(value)[:60], fix="put it in quotes"
        )
    return value


def _boolean(table: Mapping[str, object], key: str, where: str, default: bool) -> bool:
    value = table.get(key, default)
    if not isinstance(value, bool):
        raise DataError(
            f"'{key}' is not a boolean",
            where=where,
            got=repr(value)[:60],
            fix="write true or false",
        )
    return value


def _number(value: object, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise DataError("a finite number is needed here", where=where, got=repr(value)[:60])
    return float(value)
