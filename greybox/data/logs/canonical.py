"""From a table to canonical channels: what is needed must be there, and every value must be a
number."""

from __future__ import annotations

import numpy as np

from greybox.data.airframe import Airframe
from greybox.data.channel import TIME, canonical_names, group_names, is_canonical, rotor_index
from greybox.data.fingerprint import fingerprint
from greybox.data.logs.table import Table, flight_name, text_error
from greybox.data.raw import LARGEST, FloatArray, RawLog, is_numeric
from greybox.errors import DataError


def to_channels(table: Table, vehicle: Airframe | None, *, where: str) -> RawLog:
    """The columns of a table that are channels; the others are kept. Without a vehicle only `t` is
    demanded.

    Raises `DataError` for fewer than two rows, no value or text in a needed column, an infinite
    value, or a column that is not there (`t`, and with a vehicle what drives every rotor: commands,
    or rotor speeds where no column is a command).
    """
    if table.rows.size < 2:
        raise DataError(
            f"{table.rows.size} row", where=where, expected="at least 2", fix="export the whole log"
        )
    wanted = _wanted(table, vehicle)
    notes: list[str] = list(table.notes)
    channels: dict[str, FloatArray] = {}
    empty: list[str] = []
    needed = {TIME} | (set() if vehicle is None else _driving(table, len(vehicle.rotors)))
    for name in (TIME, *wanted):
        if name not in table.columns:
            if name in needed:
                raise _absent(name, table, where)
            continue
        values = _values(table, name, where)
        if not np.isfinite(values).any():
            column = table.origins.get(name, name)
            if name in needed:
                raise DataError(
                    f"column '{column}' ({name}) holds no value",
                    where=where,
                    fix="log it, or name another column",
                )
            empty.append(name)
            notes.append(f"channel {name}: column '{column}' holds no value; left out")
            continue
        channels[name] = values
    t = channels.pop(TIME)
    _demand_times(t, table, where)
    extra = {
        name: column
        for name, column in table.columns.items()
        if name != TIME and name not in wanted
    }
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
        noncausal=table.noncausal,
        recipes=table.recipes,
        empty=tuple(empty),
        notes=tuple(notes),
        fingerprint=fingerprint(channels),
    )


def _demand_times(t: FloatArray, table: Table, where: str) -> None:
    missing = np.flatnonzero(np.isnan(t))
    if missing.size:
        raise DataError(
            f"{missing.size} time stamp(s) missing",
            where=f"{where}, row {table.rows[missing[0]]}, column "
            f"'{table.origins.get(TIME, TIME)}'",
            fix="delete the rows without a time",
        )


def _wanted(table: Table, vehicle: Airframe | None) -> tuple[str, ...]:
    if vehicle is not None:
        return canonical_names(len(vehicle.rotors))
    rotors = max((rotor_index(n) or 0 for n in table.columns), default=0)
    return tuple(n for n in canonical_names(rotors) if n in table.columns and is_canonical(n))


def _driving(table: Table, rotors: int) -> set[str]:
    """The commands, or the rotor speeds where the table has no command and all of them."""
    commands, speeds = (set(group_names(g, rotors)) for g in ("command", "rotor_speed"))
    held = {
        n
        for n in (*commands, *speeds)
        if n in table.columns
        and not (is_numeric(column := table.columns[n]) and np.isnan(column).all())
    }
    return speeds if held.isdisjoint(commands) and speeds <= held else commands


def _absent(name: str, table: Table, where: str) -> DataError:
    known = ", ".join(list(table.columns)[:12]) + (", ..." if len(table.columns) > 12 else "")
    return DataError(
        f"no column '{name}' for {'the time' if name == TIME else f'the command {name}'}",
        where=where,
        got=f"columns {known}",
        fix="`greybox inspect` says what the log lacks and how to log it; a mapping file can name "
        "it; rotor speeds omega1, omega2, ... of every rotor will do in place of commands"
        if table.canonical
        else "log it, or say in [columns] of the vehicle file, or in a mapping file, which column "
        f"is {name}",
    )


def _values(table: Table, name: str, where: str) -> FloatArray:
    column = table.columns[name]
    if not is_numeric(column):
        raise text_error(table, name, name)
    values = column
    infinite = np.flatnonzero(np.abs(values) > LARGEST)
    if infinite.size:
        raise DataError(
            f"{infinite.size} infinite value(s), or larger than any sensor writes ({LARGEST:.2g})",
            where=f"{where}, row {table.rows[infinite[0]]}, column "
            f"'{table.origins.get(name, name)}' ({name})",
            fix="leave the cell empty where the value is missing",
        )
    return values
