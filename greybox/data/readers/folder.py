"""A folder of tables, one a stream, as ulog2csv, exports of bags and EuRoC's data sets write them.

Every table has a clock of its own, which its names or its steps tell and `clock` of its stream
says. Tables without one are passed over in a note. A table that has what drives the rotors and a
sensor is a flight by itself: where it stands alone or beside another the folder is no log, and so
where both stand in it twice, as A/motors, A/imu, B/motors, B/imu.
"""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from greybox.data.channel import channel, is_canonical
from greybox.data.column_guess import guess_streams, guess_time
from greybox.data.logs.csv import read_csv
from greybox.data.logs.table import Table
from greybox.data.raw import is_numeric
from greybox.data.readers.assemble import stream_of_table
from greybox.data.readers.mapping import TABLE, LogMapping
from greybox.data.readers.parquet import read_parquet
from greybox.data.readers.recording import LogFormat, Recording, Stream
from greybox.errors import DataError

_READ = {".csv": read_csv, ".csv.gz": read_csv, ".parquet": read_parquet}
DRIVEN = frozenset({"command", "rotor_speed"})
MEASURED = frozenset({"rate", "specific_force", "attitude", "position", "velocity"})
MOST, SEEN = 300, 20_000
"""Tables that are read of one folder, and files among which they are looked for, images too."""


def read_folder(path: Path) -> Recording:
    """The tables of a folder and of those in it as streams. Raises `DataError` where none has a
    clock."""
    tables: dict[str, Table] = {}
    clocks: dict[str, LogMapping | None] = {}
    groups: dict[str, set[str]] = {}
    notes: list[str] = []
    for name, file in _tables(path):
        try:
            table = _READ[_ending(file)](file)
        except DataError as error:
            notes.append(f"passed over: {error}")
            continue
        tables[name], clocks[name] = table, _clock(table)
        groups[name] = _groups(name, table)
        flights = [n for n, some in groups.items() if clocks[n] and _is_flight(some)]
        if len(flights) > 1:  # a folder of flights may be larger than the memory
            raise _no_log(path, flights, notes)
    streams: dict[str, Stream] = {}
    # A table too slow to tell the unit of its clock has that of the others.
    units = {clock.time_field: clock.time_unit for clock in clocks.values() if clock}
    for name, table in tables.items():
        same = (LogMapping(time_field=f, time_unit=u) for f, u in units.items())
        clock = clocks[name] or next((c for c in same if c.time_field in table.columns), None)
        if clock is None:
            notes.append(f"passed over: no column of {name} looks like a clock")
            continue
        found = stream_of_table(table, clock, where=f"{path}: {name}")
        streams[name] = replace(found.streams[TABLE], name=name)
    flights = _twice(streams, groups) or [n for n in streams if _is_flight(groups[n])]
    if not streams or len(flights) > 1 or (flights and len(streams) == 1):
        raise _no_log(path, flights, notes)
    return Recording(
        format=FORMAT.name,
        source=path.name,
        sha256=hashlib.sha256("".join(t.sha256 for t in tables.values()).encode()).hexdigest(),
        streams=streams,
        notes=tuple(notes),
    )


def _no_log(path: Path, flights: Sequence[str], notes: Sequence[str]) -> DataError:
    several = f"flights {', '.join(flights[:4])}" if flights else "; ".join(notes)[:200]
    return DataError(
        "a folder, not a log",
        where=str(path),
        got=several or "no table in it",
        fix="name the log files in it, or the folder of one flight",
    )


def _is_flight(groups: set[str]) -> bool:
    return bool(groups & DRIVEN and groups & MEASURED)


def _groups(name: str, table: Table) -> set[str]:
    """What the columns of a table are or look like."""
    columns = {k: v for k, v in table.columns.items() if is_numeric(v)}
    named = {channel(n).group for n in columns if is_canonical(n)}
    return named | {g.group for g in guess_streams({name: columns})}


def _twice(streams: Mapping[str, Stream], groups: Mapping[str, set[str]]) -> list[str]:
    """How the names of two flights begin: of what drives the rotors and of a sensor tables with the
    same columns, whose names end alike, stand in both; empty where there are none."""
    seen: list[set[tuple[str, ...]]] = []
    for kind in (DRIVEN, MEASURED):
        of_kind = [n for n in streams if kind & groups[n]]
        pairs = itertools.combinations(of_kind, 2)
        alike = (p for p in pairs if streams[p[0]].fields.keys() == streams[p[1]].fields.keys())
        seen.append({tuple(n.removesuffix(_end(*p)) or "." for n in p) for p in alike if _end(*p)})
    return [*min(seen[0] & seen[1], default=())]


def _end(one: str, other: str) -> str:
    """How two names end alike."""
    pairs = itertools.takewhile(lambda p: p[0] == p[1], zip(one[::-1], other[::-1], strict=False))
    return "".join(a for a, _ in pairs)[::-1]


def _tables(path: Path) -> Iterator[tuple[str, Path]]:
    """(name of the stream, file) of the tables of a folder."""
    found = (f for deep in ("*", "*/*", "*/*/*") for f in path.glob(deep))
    files = sorted(f for f in itertools.islice(found, SEEN) if _ending(f) and f.is_file())
    for file in files[:MOST]:
        yield file.relative_to(path).as_posix().removesuffix(_ending(file)), file


def _ending(file: Path) -> str:
    return next((end for end in _READ if file.name.lower().endswith(end)), "")


def _clock(table: Table) -> LogMapping | None:
    """The clock of a table by its name and its steps; None where nothing tells."""
    time = guess_time({k: v for k, v in table.columns.items() if is_numeric(v)})
    return None if time is None else LogMapping(time_field=time[0], time_unit=time[1])


FORMAT = LogFormat(
    name="folder",
    title="folder of tables",
    endings=(),
    recognise=lambda path, head: path.is_dir() and any(True for _ in _tables(path)),
    recording=read_folder,
    advice={"": "a mapping file says which columns of which table are which channels"},
)
