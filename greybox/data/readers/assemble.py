"""From a recording to one table of canonical channels: which source, its units and frames, and one
clock for all.

Rows are the samples of one stream (by default that of the body rate); `placing` says how others
come to stand in them. The battery voltage, which enters a model as an input, is interpolated at any
rate; a setpoint is held like a command.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from greybox.data.channel import GROUPS, group_names, is_canonical, rotor_index
from greybox.data.logs.table import Table, text_error
from greybox.data.placing import at_rows, commands_at
from greybox.data.raw import Column, FloatArray, is_numeric
from greybox.data.readers.axes import from_matrix, in_own_axes, needs_attitude
from greybox.data.readers.mapping import TABLE, TIME_UNITS, LogMapping
from greybox.data.readers.recipes import recipes
from greybox.data.readers.recording import UNITS, Recording, Source, Stream
from greybox.data.resampling import continuous_signs
from greybox.errors import DataError, UnknownNameError, did_you_mean

EXCITATION = "chirp"
"""Column for what the firmware added to the set points of its own accord."""
CLOCKS = (
    "rate",
    "specific_force",
    "attitude",
    "command",
    "position",
    "velocity",
    "rotor_speed",
    "battery",
)
"""Groups whose stream gives the rows, the first that is there."""

FAST_ENOUGH = 100.0
"""A source of at least this rate [Hz] is not passed over for a faster one that is liked less."""

BY_RATE = ("command", "rate", "specific_force")
"""Groups whose sources compete by rate. Poses and velocities do not: those of another origin have
another world frame."""

_TIMES = (
    "t",
    "time",
    *(f"{stem}_{unit}" for stem in ("time", "t", "timestamp") for unit in TIME_UNITS),
)
"""Columns that are the time unasked: seconds, or the unit that the name states. A bare "timestamp"
may be in any unit unless its type says so."""


def _stamps_of_two(columns: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """The time [s] of stamps in two columns, as ROS has them: seconds, and nanoseconds in them."""
    for name in columns:
        stem = re.fullmatch(r"(.*[\W_])?secs?", name)
        for part in ("nsec", "nsecs", "nanosec", "nanosecs"):
            rest = f"{stem[1] or ''}{part}" if stem else ""
            if rest in columns and np.nanmax(columns[rest], initial=0.0) < 1e9:
                return {f"{name} + {rest}": columns[name] + 1e-9 * columns[rest]}
    return {}


def stream_of_table(table: Table, mapping: LogMapping, *, where: str) -> Recording:
    """A log that is one table, as a recording of one stream. Raises `DataError` where no column is
    the time."""
    numbers = {k: v for k, v in table.columns.items() if is_numeric(v)}
    stamps = _stamps_of_two(numbers)
    numbers |= stamps
    called = {k.lower(): k for k in reversed(numbers)}
    named = mapping.time_field
    if named not in table.columns and "time" in mapping.optional:
        named = None
    typed = ["timestamp"] if called.get("timestamp") in table.seconds else []
    name = named or next(
        (called[k] for k in (*_TIMES, *typed) if k in called), next(iter(stamps), None)
    )
    if name is None or name not in numbers:
        if name is not None and name not in {*table.columns, *stamps}:
            raise UnknownNameError("column", name, table.columns, where=f"{where}: the time")
        raise DataError(
            "no column 't' for the time",
            where=where,
            got=f"columns {', '.join(list(table.columns)[:12])}",
            fix="say field and unit of [time] in a mapping file (docs/logs.md)",
        )
    if mapping.time_field is not None and named is None:
        mapping = LogMapping()  # what it says is said of a column that is not there
    unit, factor = mapping.time_unit, mapping.time_scale
    if unit is None:  # a scale alone is the whole way to seconds
        stated = factor is not None or name in {*table.seconds, *stamps}
        unit = (
            "s" if stated else next((u for u in TIME_UNITS if name.lower().endswith("_" + u)), "s")
        )
    text = tuple(k for k in table.columns if k not in numbers)
    stream = Stream(
        name=TABLE,
        t=numbers[name] * (TIME_UNITS[unit] * (1.0 if factor is None else factor))
        + (mapping.time_offset or 0.0),
        fields=numbers,
        clock=f"column {name} [{unit}]",
        unread=text,
    )
    sources = []
    rotors = max((rotor_index(k) or 0 for k in numbers), default=0)
    for group in GROUPS:
        names = group_names(group, rotors)
        if names and all(k in numbers for k in names):
            sources.append(Source(group=group, stream=TABLE, fields=names))
    return Recording(
        format="table",
        source=table.source,
        sha256=table.sha256,
        streams={TABLE: stream},
        sources=tuple(sources),
    )


def usable(recording: Recording, source: Source) -> bool:
    """Whether the recording holds the source: its stream has samples, and all its fields some
    value."""
    stream = recording.streams.get(source.stream)
    if stream is None or stream.n < 2:
        return False
    columns = [stream.fields.get(f.lstrip("-")) for f in source.fields if f]
    return all(c is not None and bool(np.isfinite(c).any()) for c in columns)


def choose(recording: Recording, mapping: LogMapping | None = None) -> dict[str, Source]:
    """The source of every group that the log has. The mapping decides; else the first good one
    whose rate will do.

    Raises `UnknownNameError` for a stream or field of the mapping that the log has not, `DataError`
    for one without values.
    """
    mapping, _ = present(recording, mapping or LogMapping())
    used = mapping.names
    out: dict[str, Source] = {}
    for group in GROUPS:
        if group in mapping.unused:
            continue
        if group in mapping.sources:
            optional = group in mapping.optional and group != "command"
            out[group] = _demanded(recording, mapping.sources[group], mapping.where, empty=optional)
            continue
        good = [s for s in recording.sources if s.group == group and usable(recording, s)]
        good = [s for s in good if s.stream != TABLE or used.isdisjoint(s.fields)]
        if group in mapping.preferred:
            wanted = mapping.preferred[group]
            good = [s for s in good if s.stream == wanted]
            if not good:
                known = sorted(
                    {
                        s.stream
                        for s in recording.sources
                        if s.group == group and usable(recording, s)
                    }
                )
                raise UnknownNameError("stream", wanted, known, where=f"{mapping.where}: {group}")
        if good:
            rates = [recording.streams[s.stream].rate for s in good]
            enough = min(FAST_ENOUGH, 0.9 * max(rates)) if group in BY_RATE else 0.0
            taken = next(s for s, rate in zip(good, rates, strict=True) if rate >= enough)
            out[group] = replace(taken, **mapping.changed.get(group, {}))
    return out


def present(recording: Recording, mapping: LogMapping) -> tuple[LogMapping, tuple[str, ...]]:
    """(the mapping without what is optional and not in the log, one note for each that was left
    out).

    Where a table has none of the columns of a group, those of our names are taken. Raises
    `UnknownNameError` for a rotor whose command alone is not there.
    """
    gone: set[str] = set()
    notes: list[str] = []
    sources = {g: _of_the_only_stream(recording, s) for g, s in mapping.sources.items()}
    for group in sorted(mapping.optional & mapping.groups, key=GROUPS.index):
        source = sources.get(group)
        name = source.stream if source is not None else mapping.preferred.get(group)
        stream = recording.streams.get(name) if name is not None else None
        if stream is None:
            if name is not None:
                gone.add(group)
            if name not in (None, TABLE):
                notes.append(f"the log has no stream {name} for the {group}")
            elif source is not None and (meant := _with_fields(recording, source)):
                notes.append(
                    f"the columns of the {group} are not used: they name no stream; say "
                    f'stream = "{meant}"'
                )
        elif source is not None:
            there = [
                f if f.lstrip("-") in {*stream.fields, *stream.unread} else ""
                for f in source.fields
            ]
            lost = [f.lstrip("-") for f, t in zip(source.fields, there, strict=True) if f and not t]
            if group == "command" and lost and any(there):
                channels = group_names(group, len(there))
                raise UnknownNameError(
                    "column",
                    lost[0],
                    stream.fields,
                    where=f"{recording.source}: the command {channels[there.index('')]}",
                )
            if lost:
                others = {*stream.fields, *stream.unread} - mapping.names
                notes.append(
                    f"the log has no {', '.join(lost)} for the {group}{did_you_mean(lost, others)}"
                )
            sources[group] = replace(source, fields=tuple(there))
            if not any(there):
                gone.add(group)
    clock = (
        None
        if "clock" in mapping.optional and mapping.clock not in recording.streams
        else mapping.clock
    )
    kept = replace(
        mapping,
        sources={g: s for g, s in sources.items() if g not in gone},
        preferred={g: s for g, s in mapping.preferred.items() if g not in gone},
        changed={g: c for g, c in mapping.changed.items() if g not in gone},
        clock=clock,
    )
    return kept, tuple(notes)


def _of_the_only_stream(recording: Recording, source: Source) -> Source:
    """A source that names no stream is one of the only stream of a log."""
    streams = list(recording.streams)
    only = source.stream == TABLE and len(streams) == 1
    return replace(source, stream=streams[0]) if only else source


def _with_fields(recording: Recording, source: Source) -> str:
    """The first stream that has all fields of a source; empty where none has."""
    wanted = {f.lstrip("-") for f in source.fields if f}
    return next((n for n, s in recording.streams.items() if wanted <= s.fields.keys()), "")


def _demanded(recording: Recording, source: Source, where: str, *, empty: bool = False) -> Source:
    """The source, which must be there, and hold some values unless it may be `empty`."""
    place = f"{where}: {source.group}"
    if source.stream not in recording.streams:
        raise UnknownNameError("stream", source.stream, recording.streams, where=place)
    stream = recording.streams[source.stream]
    for name in filter(None, source.fields):
        if name.lstrip("-") not in stream.fields:
            if name.lstrip("-") in stream.unread:
                raise DataError(f"field '{name}' of {stream.name} holds no numbers", where=place)
            raise UnknownNameError(
                "field", name.lstrip("-"), stream.fields, where=f"{place}, stream {stream.name}"
            )
    if not empty and not usable(recording, source):
        raise DataError(
            f"stream {stream.name} holds no values there", where=place, fix="name another stream"
        )
    return source


def clock_of(
    recording: Recording, chosen: Mapping[str, Source], mapping: LogMapping | None = None
) -> Source:
    """The source whose stream gives the rows. Raises `DataError` where no channel is known,
    `UnknownNameError`."""
    named = mapping.clock if mapping else None
    if named is not None:
        if named not in recording.streams:
            raise UnknownNameError(
                "stream",
                named,
                recording.streams,
                where=f"{mapping.where if mapping else ''}: clock",
            )
        own = next((s for s in chosen.values() if s.stream == named), None)
        return own or Source(group="", stream=named, fields=())
    for group in CLOCKS:
        if group in chosen:
            return chosen[group]
    raise DataError(
        "nothing in it that greybox can name",
        where=recording.source,
        got=", ".join(list(recording.streams)[:8]) or "no stream with samples",
        fix="write a mapping file (docs/logs.md) and pass --mapping",
    )


def assemble(recording: Recording, mapping: LogMapping | None = None) -> Table:
    """One table of canonical channels. Raises `DataError` and `UnknownNameError` (see `choose`,
    `clock_of`)."""
    # Damaged logs hold numbers of any size; what overflows is infinite and refused by name later.
    with np.errstate(all="ignore"):
        return _assembled(recording, mapping)


def _assembled(recording: Recording, mapping: LogMapping | None) -> Table:
    mapping, absent = present(recording, mapping or LogMapping())
    chosen = choose(recording, mapping)
    clock = clock_of(recording, chosen, mapping)
    base = recording.streams[clock.stream]
    if base.n < 2:
        raise DataError(
            f"stream {base.name} has {base.n} samples",
            where=recording.source,
            expected="at least 2",
        )
    grid = _Grid(recording, base, clock)
    grid.notes += absent
    if abs(grid.zero) > 1e-9:
        grid.notes.append(
            f"t = 0 is {grid.zero:.6f} s on the clock of the log ({base.clock or base.name})"
        )
    for group in sorted(chosen, key=lambda g: g != "attitude"):
        grid.add(group, chosen[group])
    return grid.table()


class _Grid:
    """The rows of a table that is being filled, at the stamps of the stream `base` less the delay
    of what `clock` says."""

    def __init__(self, recording: Recording, base: Stream, clock: Source) -> None:
        self.recording, self.base, self.clock = recording, base, clock
        # The columns of a table that nobody named stand at its stamps.
        self.early = 0.0 if base.name == TABLE else clock.delay
        self.rows = base.t - self.early
        known = self.rows[np.isfinite(self.rows)]
        self.zero = float(known[0]) if known.size else 0.0
        self.columns: dict[str, Column] = {"t": self.rows - self.zero}
        self.notes = list(recording.notes)
        self.noncausal: set[str] = set()
        self.recipes: dict[str, str] = {}
        self.attitude: tuple[FloatArray, FloatArray] | None = None

    def add(self, group: str, source: Source) -> None:
        """Place one group; what cannot be placed is left out with a note. Raises `DataError` for
        commands on another clock."""
        base, stream = self.base, self.recording.streams[source.stream]
        direct = source.stream == self.clock.stream and source.delay == self.early
        values = converted(stream, source)
        infinite = np.isinf(values)
        t, values = (self.rows, values) if direct else _increasing(stream.t - source.delay, values)
        apart = "" if direct else _apart(t, self.rows)
        if apart:
            said = (
                f"{describe(source, stream)}: another clock than the rows of {base.name}: {apart}"
            )
            if group == "command":
                raise DataError(
                    said, where=self.recording.source, fix=f"set [{group}] delay in a mapping file"
                )
            self.notes.append(f"left out, {said}; set [{group}] delay in a mapping file")
            return
        if group == "attitude":
            self.attitude = _increasing(t, values)
        if what := needs_attitude(source):
            if self.attitude is None:
                self.notes.append(f"{what} left out: there is no attitude to turn it")
                return
            # An attitude between samples is no measurement, but turns a vector well enough.
            turn = _unit(at_rows(*self.attitude, t, stream.step, sparse=False))
            values = in_own_axes(values, turn, source)
        placed = values if direct else self._placed(group, stream, t, values)
        if infinite.any() and not direct and stream.name == TABLE:
            placed = np.where(infinite, np.inf, placed)  # refused later by the number of its row
        names = group_names(group, values.shape[1])
        self.columns.update({n: np.ascontiguousarray(placed[:, j]) for j, n in enumerate(names)})
        self.recipes.update(recipes(source))
        if not source.causal:
            self.noncausal.update(names)
        self.notes.append(describe(source, stream))
        if group == "command" and stream.rate < 0.6 * base.rate and stream.rate < 90:
            self.notes.append(
                f"commands were logged at {stream.rate:.3g} Hz only: what was sent between two of "
                "them is not known, and the fit will be poor (`greybox inspect` says what to set)"
            )

    def _placed(self, group: str, stream: Stream, t: FloatArray, values: FloatArray) -> FloatArray:
        """Values (n, k) at stamps t (n,) as they are at the rows: held, or between samples."""
        rows, base = self.rows, self.base
        if group in ("command", "setpoint"):
            return commands_at(t, values, rows, base.step, stream.step)
        placed = at_rows(t, values, rows, base.step, step=stream.step, sparse=group != "battery")
        if group != "attitude":
            return placed
        turned = _unit(placed)
        return np.where(np.isnan(turned), placed, turned) if stream.name == TABLE else turned

    def table(self) -> Table:
        """What was placed, with the drop-outs of the recording."""
        recording, columns = self.recording, self.columns
        if recording.excitation is not None and recording.excitation.size == self.rows.size:
            columns[EXCITATION] = recording.excitation
        notes = [
            *self.notes,
            *(
                f"the logger lost data for {1e3 * length:.0f} ms at t = {start - self.zero:.3f} s"
                for start, length in recording.dropouts[:5]
            ),
        ]
        if len(recording.dropouts) > 5:
            notes.append(f"... and {len(recording.dropouts) - 5} more drop-outs")
        return Table(
            columns={n: columns[n] for n in columns if n in ("t", EXCITATION) or is_canonical(n)},
            rows=np.arange(1, self.rows.size + 1, dtype=np.int64),
            source=recording.source,
            sha256=recording.sha256,
            canonical=True,
            noncausal=frozenset(self.noncausal),
            recipes=self.recipes,
            notes=tuple(notes),
        )


def _apart(t: FloatArray, rows: FloatArray) -> str:
    """How far stamps that never meet the rows lie from them, in words; empty where they meet."""
    known = rows[np.isfinite(rows)]
    if not t.size or not known.size or (t[0] <= known.max() and t[-1] >= known.min()):
        return ""
    return f"it begins {t[0] - known.min():+.3f} s from them"


def describe(source: Source, stream: Stream) -> str:
    """One line: which channels come from where, in which unit and frame, and how often."""
    names = group_names(source.group, len(source.fields))
    shown = f"{names[0]}..{names[-1]}" if len(names) > 3 else ", ".join(names)
    there = [f for f in source.fields if f]
    fields = ", ".join(there[:4]) + (", ..." if len(there) > 4 else "")
    how = [] if stream.name == TABLE else [f"{stream.rate:.4g} Hz"]
    how += [source.unit] if source.unit not in ("", "1") else []
    how += [source.frame] if source.frame else []
    how += [] if source.gravity else ["without gravity"]
    how += [f"{source.limits[0]:g}..{source.limits[1]:g}"] if source.limits else []
    how += [f"{1e3 * source.delay:.3g} ms earlier than its stamps"] if source.delay else []
    if stream.name == TABLE:
        return f"{shown}: columns {fields}{f' ({comma})' if (comma := ', '.join(how)) else ''}"
    how += [source.note] if source.note else []
    return f"{shown}: {stream.name} [{fields}] ({', '.join(how)})"


def _rotations(name: str, *arrays: FloatArray) -> FloatArray:
    """`greybox.frames.numeric`, loaded on first use: it brings CasADi."""
    from greybox.frames import numeric

    return numeric(name, *arrays)


def converted(stream: Stream, source: Source) -> FloatArray:
    """Values (N, K) of a source in our units and frames, row by row; vectors may be in other axes
    than their group's.

    What is infinite, or a quaternion not of unit length, is missing, but in a table, where it is
    judged later by the number of its row.
    """
    columns = []
    for name in source.fields:
        values = stream.fields[name.lstrip("-")] if name else np.full(stream.n, np.nan)
        columns.append(-values if name.startswith("-") else values)
    matrix: FloatArray = np.column_stack(columns).astype(np.float64)
    if stream.name != TABLE:
        matrix[~np.isfinite(matrix)] = np.nan
    if source.convert is not None:
        matrix = source.convert(matrix)
    factor = UNITS.get(source.group, {}).get(source.unit, 1.0) * np.asarray(source.scale)
    if np.any(factor != 1.0):
        matrix = matrix * factor
    if np.any(np.asarray(source.offset) != 0.0):
        matrix = matrix + np.asarray(source.offset)
    if source.limits is not None:
        low, high = source.limits
        matrix = (matrix - low) / (high - low)
    if source.group == "attitude" and matrix.shape[1] != 4:
        angles = matrix.shape[1] == 3
        matrix = _rotations("from_euler", matrix) if angles else from_matrix(matrix)
    matrix = other_frame(matrix, source.group, source.frame)
    if source.group != "attitude":
        return matrix
    return continuous_signs(matrix if stream.name == TABLE else _unit(matrix))[0]


def _increasing(t: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The samples at times that grow; of several at one time the first."""
    good = np.isfinite(t)
    if good.all() and bool((np.diff(t) > 0).all()):
        return t, values
    order = np.flatnonzero(good)[np.argsort(t[good], kind="stable")]
    first = np.concatenate([[True], np.diff(t[order]) > 0])
    return t[order][first], values[order][first]


def in_channels(table: Table, mapping: LogMapping) -> Table:
    """A table with columns of its own, in canonical channels as a mapping says.

    Rows, their numbers and their stamps stay, and so do columns that are no channel of a group that
    is named. Raises `DataError` and `UnknownNameError` (see `assemble`).
    """
    if table.rows.size < 2:
        return table  # refused later, as one without a mapping
    for name in {mapping.time_field or "t"} & set(table.columns):
        if not is_numeric(table.columns[name]):
            raise text_error(table, name, "t")
    recording = stream_of_table(table, mapping, where=table.source)
    stream = recording.streams[TABLE]
    for name in mapping.names & set(stream.unread):
        raise text_error(table, name, name)
    kept, absent = present(recording, mapping)
    turned = any(needs_attitude(s) for s in kept.sources.values())
    told = kept.groups | ({"attitude"} if turned else set())
    sources = {g: s for g, s in choose(recording, mapping).items() if g in told}
    own = replace(table, columns={}, canonical=True, notes=absent)
    if sources:
        own = assemble(
            replace(recording, sources=tuple(s for s in recording.sources if s.group in told)),
            mapping,
        )
    origins: dict[str, str] = {}
    for group, source in sources.items():
        names = group_names(group, len(source.fields))
        if len(names) == len(source.fields):
            origins |= {n: f.lstrip("-") for n, f in zip(names, source.fields, strict=True) if f}
    read = {f.lstrip("-") for s in sources.values() for f in s.fields}
    used = {*mapping.names, *read, *(n for g in told for n in group_names(g, 99))}
    return replace(
        own,
        columns={
            **own.columns,
            "t": stream.t,
            **{n: c for n, c in table.columns.items() if n not in used | {"t"}},
        },
        rows=table.rows,
        origins=origins,
        notes=tuple(n for n in own.notes if not n.startswith("t = 0 is ")),
    )


def other_frame(values: FloatArray, group: str, frame: str) -> FloatArray:
    """Values (N, K) of a group in one of its `FRAMES` turned to ours, or ours to it: each turn is
    its own inverse."""
    if group == "attitude":
        if frame != "FRD/NED":
            return values
        # v_ENU = R(earth) v_NED and v_FRD = R(body) v_FLU are turns by pi about (1, 1, 0) and about
        # x.
        half = np.sqrt(0.5)
        earth = np.tile([0.0, half, half, 0.0], (len(values), 1))
        body = np.tile([0.0, 1.0, 0.0, 0.0], (len(values), 1))
        return _rotations("multiply", _rotations("multiply", earth, values), body)
    if frame == "FRD":
        return values * np.array([1.0, -1.0, -1.0])
    if frame == "NED":
        return values[:, [1, 0, 2]] * np.array([1.0, 1.0, -1.0])
    return values


def _unit(quaternions: FloatArray) -> FloatArray:
    """Quaternions (N, 4) of unit length; NaN where the length is not within a tenth of one."""
    norm = np.linalg.norm(quaternions, axis=1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(np.abs(norm - 1.0) < 0.1, quaternions / norm, np.nan)
