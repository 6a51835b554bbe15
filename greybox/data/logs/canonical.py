"""From a file's own columns to canonical channels: names, scales, signs and units change here and nowhere else."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from greybox.data.airframe import Airframe
from greybox.data.channel import TIME, ColumnSpec, canonical_names, group_names, is_canonical, rotor_index
from greybox.data.logs.table import Table, flight_name
from greybox.data.raw import LARGEST, FloatArray, RawLog
from greybox.errors import DataError, UnknownNameError


def to_channels(table: Table, vehicle: Airframe | None, *, where: str) -> RawLog:
    """Apply the vehicle's `[columns]` to a table. Without a vehicle only `t` is demanded, canonical names count.

    Raises `DataError` for fewer than two rows, no value or text in a needed column, or an infinite value, and
    `UnknownNameError` for a column that is not there (`t`, and with a vehicle every command).
    """
    if table.rows.size < 2:
        raise DataError(f"{table.rows.size} row", where=where, expected="at least 2", fix="export the whole log")
    specs: dict[str, ColumnSpec] = {} if vehicle is None or table.canonical else dict(vehicle.columns)
    used = {spec.name for spec in specs.values()}
    wanted = _wanted(table, vehicle)
    notes: list[str] = list(table.notes)
    channels: dict[str, FloatArray] = {}
    empty: list[str] = []
    needed = {TIME} | (set() if vehicle is None else set(group_names("command", len(vehicle.rotors))))
    taken: set[str] = set()
    for name in (TIME, *wanted):
        spec = specs.get(name)
        if spec is None:
            if name in used:
                continue  # the vehicle gives this column to another channel
            spec = ColumnSpec(name=name)
        if spec.name not in table.columns:
            if name in needed:
                raise _absent(name, spec, table, where)
            if name in specs:
                notes.append(f"the log has no column '{spec.name}' for channel {name}")
            continue
        taken.add(spec.name)
        values = _values(table, spec, name, where)
        if not np.isfinite(values).any():
            if name in needed:
                raise DataError(
                    f"column '{spec.name}' ({name}) holds no value", where=where, fix="log it, or name another column"
                )
            empty.append(name)
            notes.append(f"channel {name}: column '{spec.name}' holds no value; left out")
            continue
        channels[name] = values
    t = channels.pop(TIME)
    missing = np.flatnonzero(np.isnan(t))
    if missing.size:
        raise DataError(
            f"{missing.size} time stamp(s) missing",
            where=f"{where}, row {table.rows[missing[0]]}, column '{specs.get(TIME, ColumnSpec(name=TIME)).name}'",
            fix="delete the rows without a time",
        )
    extra = {name: column for name, column in table.columns.items() if name not in taken}
    if extra:
        notes.append("columns kept but not used: " + ", ".join(extra))
    return RawLog(
        t=t,
        channels=channels,
        extra=extra,
        rows=table.rows,
        flight=flight_name(table.source),
        source=table.source,
        sha256=table.sha256,
        noncausal=table.noncausal | frozenset(n for n in channels if n in specs and not specs[n].causal),
        empty=tuple(empty),
        notes=tuple(notes),
    )


def _wanted(table: Table, vehicle: Airframe | None) -> tuple[str, ...]:
    if vehicle is not None:
        return canonical_names(len(vehicle.rotors))
    rotors = max((rotor_index(n) or 0 for n in table.columns), default=0)
    return tuple(n for n in canonical_names(rotors) if n in table.columns and is_canonical(n))


def _absent(name: str, spec: ColumnSpec, table: Table, where: str) -> UnknownNameError | DataError:
    what = "the time" if name == TIME else f"the command {name}"
    if spec.name == name:
        known = ", ".join(list(table.columns)[:12]) + (", ..." if len(table.columns) > 12 else "")
        return DataError(
            f"no column '{name}' for {what}",
            where=where,
            got=f"columns {known}",
            fix="`greybox inspect` says what the log lacks and how to log it; a mapping file can name it"
            if table.canonical
            else f"log it, or say in [columns] of the vehicle file, or in a mapping file, which column is {name}",
        )
    return UnknownNameError("column", spec.name, table.columns, where=f"{where}: {what}")


def _values(table: Table, spec: ColumnSpec, name: str, where: str) -> FloatArray:
    column: npt.NDArray[Any] = table.columns[spec.name]
    if column.dtype.kind != "f":
        row, cell = _first_text(table, column)
        raise DataError(
            f"'{cell}' is not a number",
            where=f"{where}, row {row}, column '{spec.name}' ({name})",
            fix="leave the cell empty where the value is missing",
        )
    with np.errstate(over="ignore"):
        scaled: FloatArray = column * spec.scale + spec.offset if (spec.scale, spec.offset) != (1.0, 0.0) else column
    infinite = np.flatnonzero(np.abs(scaled) > LARGEST)
    if infinite.size:
        raise DataError(
            f"{infinite.size} infinite value(s), or larger than any sensor writes ({LARGEST:.2g})",
            where=f"{where}, row {table.rows[infinite[0]]}, column '{spec.name}' ({name})",
            fix="leave the cell empty where the value is missing",
        )
    return scaled


def _first_text(table: Table, column: npt.NDArray[Any]) -> tuple[int, str]:
    for row, cell in zip(table.rows, column, strict=True):
        try:
            float(str(cell) or "nan")
        except ValueError:
            text = str(cell)
            return int(row), text if len(text) <= 30 else text[:27] + "..."
    raise AssertionError("a text column without text")
