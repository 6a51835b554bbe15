"""Readers of logs as they come: one file per format, each with one `FORMAT`; a new format is one
file and one line here.

A format is recognised by the first bytes of the file, then by its ending; everything else is read
as CSV. Libraries of a format are imported when a file of it is read (the extra `logs`).
"""

from __future__ import annotations

import os
from pathlib import Path

from greybox.data.logs.table import Table
from greybox.data.readers.ardupilot import FORMAT as ARDUPILOT
from greybox.data.readers.assemble import (
    assemble,
    choose,
    clock_of,
    describe,
    in_channels,
    stream_of_table,
)
from greybox.data.readers.betaflight import FORMAT as BETAFLIGHT
from greybox.data.readers.crazyflie import FORMAT as CRAZYFLIE
from greybox.data.readers.csv_table import FORMAT as CSV
from greybox.data.readers.folder import FORMAT as FOLDER
from greybox.data.readers.mapping import LogMapping, read_mapping
from greybox.data.readers.matlab import FORMAT as MATLAB
from greybox.data.readers.numpy_archive import FORMAT as NUMPY
from greybox.data.readers.parquet import FORMAT as PARQUET
from greybox.data.readers.recording import LogFormat, Recording, Source, Stream
from greybox.data.readers.ros import FORMAT as ROS
from greybox.data.readers.ulog import FORMAT as ULOG
from greybox.errors import DataError

__all__ = [
    "FORMATS",
    "LogFormat",
    "LogMapping",
    "Recording",
    "Source",
    "Stream",
    "assemble",
    "choose",
    "clock_of",
    "describe",
    "format_of",
    "read_columns",
    "read_mapping",
    "read_recording",
]

FORMATS: tuple[LogFormat, ...] = (
    ULOG,
    ROS,
    BETAFLIGHT,
    ARDUPILOT,
    CRAZYFLIE,
    MATLAB,
    PARQUET,
    NUMPY,
    FOLDER,
    CSV,
)
"""All formats, in the order in which they are asked; the last takes what is left."""


def format_of(path: str | os.PathLike[str]) -> LogFormat:
    """The format of a log, by its first bytes, then by its ending. Raises `DataError` where there
    is no such file."""
    where = Path(path)
    head = b""
    if not where.is_dir():
        # opening a pipe waits for who writes it, and what was read of one is gone when the reader
        # begins
        if where.exists() and not where.is_file():
            raise DataError(
                "a pipe or a device, not a file",
                where=str(path),
                fix="write the log into a file first",
            )
        try:
            with where.open("rb") as stream:
                head = stream.read(512)
        except FileNotFoundError:
            raise DataError("no such log", where=str(path), fix="check the path") from None
        except OSError as error:
            raise DataError(
                f"cannot read: {error.strerror or error}",
                where=str(path),
                fix="check the permissions",
            ) from None
    for one in FORMATS:
        if one.recognise(where, head):
            return one
    name = where.name.lower()
    return next((f for f in FORMATS if name.endswith(f.endings)), FORMATS[-1])


def read_recording(path: str | os.PathLike[str], mapping: LogMapping | None = None) -> Recording:
    """What a log of any format holds. Raises `DataError` for a file that cannot be read."""
    one = format_of(path)
    where = os.fspath(path)
    if one.recording is not None:
        return one.recording(Path(path))
    assert one.table is not None
    table = one.table(path)
    found = stream_of_table(table, mapping or LogMapping(), where=where)
    return Recording(
        format=one.name,
        source=found.source,
        sha256=found.sha256,
        streams=found.streams,
        sources=found.sources,
    )


def read_columns(
    path: str | os.PathLike[str] | Recording,
    mapping: str | os.PathLike[str] | LogMapping | None = None,
) -> Table:
    """A log of any format, or what a reader of one's own made of it, as one table. Logs that are a
    table keep their own columns where no mapping is given.

    All others, and all with a mapping (a `LogMapping` or the path of its file), come in canonical
    channels; what no channel is made of stays in a table. Raises `DataError` and
    `UnknownNameError`.
    """
    if mapping is not None and not isinstance(mapping, LogMapping):
        mapping = read_mapping(mapping)
    if isinstance(path, Recording):
        return assemble(path, mapping)
    one = format_of(path)
    if one.table is not None:
        table = one.table(path)
        return in_channels(table, mapping) if mapping else table
    return assemble(read_recording(path, mapping), mapping)
