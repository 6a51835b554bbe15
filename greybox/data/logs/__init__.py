"""Log formats: one reader per file, and the calls that turn a file into a conditioned flight."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from greybox.data.airframe import Airframe
from greybox.data.conditioning import MAX_GAP, condition
from greybox.data.dataset import Dataset, Flight
from greybox.data.logs.canonical import to_channels
from greybox.data.logs.csv import read_csv
from greybox.data.logs.table import Table
from greybox.data.raw import RawLog

__all__ = ["READERS", "LogFormat", "RawLog", "Table", "read_log", "read_logs", "read_table"]

Path = str | os.PathLike[str]


@dataclass(frozen=True, kw_only=True)
class LogFormat:
    """One log format: the endings of its files and its reader. A file with another ending is read as CSV."""

    name: str
    endings: tuple[str, ...]
    read: Callable[[Path], Table]


READERS = (LogFormat(name="csv", endings=(".csv", ".csv.gz"), read=read_csv),)


def read_table(path: Path, vehicle: Airframe | None = None) -> RawLog:
    """Read a log into canonical channels on its own clock, which is not judged here.

    Raises `DataError` or `UnknownNameError` where the file is not a log of this vehicle.
    """
    where = os.fspath(path)
    form = next((f for f in READERS if where.lower().endswith(f.endings)), READERS[0])
    return to_channels(form.read(path), vehicle, where=where)


def read_log(
    path: Path,
    vehicle: Airframe | None = None,
    *,
    rate: float | None = None,
    trim: bool = True,
    max_gap: float = MAX_GAP,
) -> Flight:
    """Read one log and condition it: uniform clock, gaps as missing cells or segment breaks, airborne part only.

    `rate` [Hz] resamples to that rate (None: the log's own); `trim=False` keeps take-off and landing; `max_gap` [s] is
    the longest stretch without samples inside a segment. The flight's `notes` say what was done. The flight is named
    after the file. Without a vehicle only the column `t` is demanded. Raises `DataError`, also where time goes back or
    stands still, and `UnknownNameError` for a column that the vehicle names and the log has not.
    """
    return condition(read_table(path, vehicle), vehicle, rate=rate, trim=trim, max_gap=max_gap, where=os.fspath(path))


def read_logs(
    paths: Iterable[Path],
    vehicle: Airframe | None = None,
    *,
    rate: float | None = None,
    trim: bool = True,
    max_gap: float = MAX_GAP,
) -> Dataset:
    """Read several logs of one vehicle (see `read_log`) into a data set. Raises `DataError` for equal file names."""
    return Dataset(flights=tuple(read_log(p, vehicle, rate=rate, trim=trim, max_gap=max_gap) for p in paths))
