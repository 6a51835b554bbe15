"""Log formats: the calls that turn a file of any format into a conditioned flight.

Files are read in greybox.data.readers, one file per format; units and frames of the contract are
made there and in `canonical`.
"""

from __future__ import annotations

import os
from collections.abc import Iterable

from greybox.data.airframe import Airframe
from greybox.data.conditioning import MAX_GAP, condition
from greybox.data.dataset import Dataset, Flight
from greybox.data.impossible import without_impossible
from greybox.data.logs.canonical import to_channels
from greybox.data.logs.table import Table
from greybox.data.raw import RawLog
from greybox.data.readers import LogMapping, Recording, read_columns, read_mapping
from greybox.data.repeats import without_repeats
from greybox.errors import DataError
from greybox.takes import LOG, LOG_FILES, MAPPING, VEHICLE, takes

__all__ = ["RawLog", "Table", "read_log", "read_logs", "read_possible", "read_table"]

Path = str | os.PathLike[str]
Log = Path | Recording
"""A log file, or what a reader of one's own made of one."""


def _where(log: Log) -> str:
    """What messages call a log."""
    return log.source if isinstance(log, Recording) else os.fspath(log)


def read_table(
    path: Log, vehicle: Airframe | None = None, *, mapping: Path | LogMapping | None = None
) -> RawLog:
    """A log of any format, or a `Recording`, in canonical channels on its own clock, which is not
    judged here.

    `mapping` is a mapping file (schema "greybox.mapping/1") that says which fields are which
    channels, for logs whose names greybox does not know; what it leaves open the vehicle's
    `columns` say. Raises `DataError` or `UnknownNameError` where the file is not a log of this
    vehicle.
    """
    return to_channels(
        read_columns(path, mapping_for(vehicle, mapping)), vehicle, where=_where(path)
    )


def mapping_for(vehicle: Airframe | None, mapping: Path | LogMapping | None) -> LogMapping:
    """What a mapping file (or its path) and the vehicle's `columns` say of a log; the file comes
    first. Raises `DataError`, `UnknownNameError`."""
    said = (
        mapping
        if isinstance(mapping, LogMapping)
        else LogMapping()
        if mapping is None
        else read_mapping(mapping)
    )
    return said if vehicle is None else said.over(vehicle.columns)


def read_possible(
    path: Log,
    vehicle: Airframe | None = None,
    *,
    mapping: Path | LogMapping | None = None,
    keep_impossible: bool = False,
) -> RawLog:
    """`read_table` with samples that this vehicle cannot have made as missing cells, listed in
    `removed`, and with what only repeats a slow stream's last sample (`without_repeats`).

    The door by which every command and `read_logs` get logs; a data-fault check looks at
    `read_table`.
    """
    raw = without_repeats(read_table(path, vehicle, mapping=mapping))
    return raw if vehicle is None or keep_impossible else without_impossible(raw, vehicle)


@takes(path=LOG, vehicle=VEHICLE, mapping=MAPPING)
def read_log(
    path: Log,
    vehicle: Airframe | None = None,
    *,
    rate: float | None = None,
    trim: bool = True,
    max_gap: float = MAX_GAP,
    mapping: Path | LogMapping | None = None,
    keep_impossible: bool = False,
) -> Flight:
    """Read one log of any format (or a `Recording` that a reader of one's own made) and condition
    it: uniform clock, gaps as missing cells or breaks, airborne part only.

    `rate` [Hz] resamples to that rate (None: the log's own); `trim=False` keeps take-off and
    landing; `max_gap` [s] is the longest stretch without samples inside a segment. Samples that the
    vehicle cannot have made become missing and are listed in `removed` (`keep_impossible`: they
    stay). The flight's `notes` say what was done. The flight is named after the file. Without a
    vehicle only the column `t` is demanded. Raises `DataError`, also where time goes back or stands
    still, and `UnknownNameError` for a column that the vehicle names and the log has not.
    """
    raw = read_possible(path, vehicle, mapping=mapping, keep_impossible=keep_impossible)
    return condition(raw, vehicle, rate=rate, trim=trim, max_gap=max_gap, where=_where(path))


@takes(paths=LOG_FILES, vehicle=VEHICLE, mapping=MAPPING)
def read_logs(
    paths: Iterable[Log] | Log,
    vehicle: Airframe | None = None,
    *,
    rate: float | None = None,
    trim: bool = True,
    max_gap: float = MAX_GAP,
    mapping: Path | LogMapping | None = None,
    keep_impossible: bool = False,
) -> Dataset:
    """Read one or several logs of one vehicle (see `read_log`) into a data set. Raises `DataError`
    for equal file names."""
    logs = [paths] if isinstance(paths, str | os.PathLike | Recording) else list(paths)
    if not logs:
        raise DataError("no logs", expected="one path or more")
    if mapping is not None and not isinstance(mapping, LogMapping):
        mapping = read_mapping(mapping)
    return Dataset(
        flights=tuple(
            read_log(
                p,
                vehicle,
                rate=rate,
                trim=trim,
                max_gap=max_gap,
                mapping=mapping,
                keep_impossible=keep_impossible,
            )
            for p in logs
        )
    )
