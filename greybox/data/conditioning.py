"""Conditioning: from a raw log to segments on a uniform clock. Everything that is done is said in
the flight's notes.

A missing sample becomes missing cells (NaN); only commands are carried over it: they hold until the
next one, and those that a lost row took along lie between their neighbours. A longer gap ends the
segment.
"""

from __future__ import annotations

import numbers
from collections.abc import Mapping
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from greybox.data.airborne import airborne
from greybox.data.airframe import Airframe
from greybox.data.channel import command_names, group_names
from greybox.data.clock import (
    GOES_BACK,
    STANDS_STILL,
    UNIT,
    Clock,
    backward_rows,
    no_flight_log,
    read_clock,
)
from greybox.data.dataset import Flight
from greybox.data.drive import drive_names
from greybox.data.placing import at_rows, commands_at
from greybox.data.raw import Column, RawLog
from greybox.data.resampling import AVERAGE_FROM, held
from greybox.data.segment import Segment
from greybox.errors import DataError
from greybox.runs import runs
from greybox.takes import POSITIVE, shown

FloatArray = npt.NDArray[np.float64]
Columns = dict[str, Column]
Kind = TypeVar("Kind", bound=np.generic)

MAX_GAP = 0.1
"""Longest stretch without samples inside a segment [s]."""

SHORT = 20
"""Segments of fewer samples are dropped where there is a longer one."""


def condition(
    raw: RawLog,
    vehicle: Airframe | None = None,
    *,
    rate: float | None = None,
    trim: bool = True,
    max_gap: float = MAX_GAP,
    where: str = "",
) -> Flight:
    """Turn a raw log into a flight of uniform segments; see `greybox.data.logs.read_log` for the
    options.

    Raises `DataError` where time goes back or stands still, where no command is known anywhere, or
    for a bad `rate` or `max_gap`.
    """
    where = where or raw.source
    _demand_choices(rate, max_gap, where)
    _demand_increasing(raw, where)
    notes = list(raw.notes)
    channels: dict[str, FloatArray] = dict(raw.channels)
    notes += _mask_quaternions(channels)
    keep = np.ones(raw.n, dtype=bool)
    driving = drive_names(channels, len(vehicle.rotors)) if vehicle else command_names(channels)
    if trim:
        sent = bool(command_names(driving))
        u_min = vehicle.actuator.u_min if vehicle and sent else 0.0
        keep, cuts = airborne(raw.t, channels, driving=driving, u_min=u_min)
        notes += cuts
    clock = read_clock(raw.t, max_gap=max_gap)
    linear_hold = vehicle is not None and vehicle.actuator.hold == "linear"
    own = None if clock.uniform else _clock_of_the_gyro(raw.t, channels, max_gap)
    if own is not None and not (rate is None or abs(rate * own[0].dt - 1.0) < 1e-6):
        own = None
    on_grid = clock.uniform and (rate is None or abs(rate * clock.dt - 1.0) < 1e-6)
    dt = own[0].dt if own else clock.dt if on_grid else 1.0 / (rate or _round_rate(clock.dt))
    notes.append(_clock_note(clock, dt, on_grid, own is not None))
    pieces: list[Segment] = []
    for start, stop in _stretches(clock, keep):
        if stop - start < 2:
            notes.append(f"dropped a single sample at t = {raw.t[start]:.3f} s")
            continue
        rows = slice(start, stop)
        part = (
            raw.t[rows],
            {k: v[rows] for k, v in channels.items()},
            {k: v[rows] for k, v in raw.extra.items()},
        )
        if on_grid:
            pieces += _placed(part, clock.slots[rows], dt, raw.flight)
        else:
            start_at, step = (part[0][0], clock.dt) if own is None else _begins(*own, part[0])
            pieces += _resampled(part, start_at, dt, step, raw.flight, linear_hold)
    pieces, said = _with_drive(pieces, driving, max_gap)
    notes += said
    if not pieces and (wrong := no_flight_log(1.0 / clock.dt)) is not None:
        raise DataError(wrong, where=where, fix=UNIT)
    return _flight(raw, pieces, notes, where)


def _demand_choices(rate: float | None, max_gap: float, where: str) -> None:
    if rate is not None and not POSITIVE.fits(rate):
        raise DataError(f"rate {shown(rate)}", expected="a positive number of Hz", where=where)
    if not (isinstance(max_gap, numbers.Real) and max_gap > 0):  # infinite: no gap
        raise DataError(
            f"max_gap {shown(max_gap)}", expected="a positive number of seconds", where=where
        )


def _clock_of_the_gyro(
    t: FloatArray, channels: Mapping[str, FloatArray], max_gap: float
) -> tuple[Clock, FloatArray] | None:
    """The uniform clock of the rows with a body rate, and their stamps, where only these have one:
    a table that holds the rows of several streams, as an outer merge of them does."""
    names = [n for n in group_names("rate") if n in channels]
    known = np.isfinite([channels[n] for n in names]).all(axis=0) if names else np.zeros(0, bool)
    if known.sum() < SHORT or known.all():
        return None
    clock = read_clock(t[known], max_gap=max_gap)
    return (clock, t[known]) if clock.uniform else None


def _begins(clock: Clock, stamps: FloatArray, t: FloatArray) -> tuple[float, float]:
    """(first of the `stamps` in a stretch with rows at `t`, their sample time) [s]."""
    at = int(np.searchsorted(stamps, t[0] - 1e-9))
    return float(stamps[at]) if at < stamps.size and stamps[at] < t[-1] else float(t[0]), clock.dt


def _demand_increasing(raw: RawLog, where: str) -> None:
    bad = backward_rows(raw.t)
    if bad.size:
        k = int(bad[0])
        still = raw.t[k] == raw.t[k - 1]
        what = "the same time stamp twice" if still else "time goes back"
        raise DataError(
            f"{what} ({raw.t[k - 1]:.6f} s, then {raw.t[k]:.6f} s; {bad.size} such row(s))",
            where=f"{where}, row {raw.rows[k]}",
            fix=STANDS_STILL if still else GOES_BACK,
        )


def _mask_quaternions(channels: dict[str, FloatArray]) -> list[str]:
    names = group_names("attitude")
    if not all(n in channels for n in names):
        return []
    norm = np.sqrt(sum(channels[n] ** 2 for n in names))
    bad = np.abs(norm - 1.0) > 0.1
    if not bad.any():
        return []
    for n in names:
        channels[n] = np.where(bad, np.nan, channels[n])
    return [
        f"attitude: {int(bad.sum())} row(s) whose quaternion is not of unit length taken as missing"
    ]


def _round_rate(dt: float) -> float:
    return float(f"{1.0 / dt:.2g}")


def _clock_note(clock: Clock, dt: float, on_grid: bool, merged: bool) -> str:
    if merged:
        return (
            f"clock: rows of several streams, {1 / clock.dt:.4g} Hz in all; those of the gyro are "
            f"uniform, {1 / dt:.6g} Hz, and what the others hold is put beside them"
        )
    if on_grid:
        return (
            f"clock: uniform, {1 / dt:.6g} Hz, stamps moved by at most {clock.shift * 1e3:.3g} ms"
        )
    kind = "uniform" if clock.uniform else f"not uniform (steps vary by {100 * clock.jitter:.0f} %)"
    if dt > AVERAGE_FROM * clock.dt:
        how = (
            "measurements averaged around each sample, commands averaged over the interval after it"
        )
    else:
        how = "measurements interpolated linearly, commands held"
    return f"clock: {kind}, {1 / clock.dt:.6g} Hz; resampled to {1 / dt:.6g} Hz, {how}"


def _stretches(clock: Clock, keep: npt.NDArray[np.bool_]) -> list[tuple[int, int]]:
    """(start, stop) rows of the kept stretches that no gap interrupts."""
    out = []
    for start, stop in clock.blocks:
        out += [(start + a, start + b) for a, b in runs(keep[start:stop])]
    return out


Part = tuple[FloatArray, dict[str, FloatArray], Columns]


def _placed(part: Part, slots: npt.NDArray[np.int64], dt: float, flight: str) -> list[Segment]:
    """Rows of a uniform clock on their grid slots; slots without a row are missing."""
    t, channels, extra = part
    slots = slots - slots[0]
    n = int(slots[-1]) + 1
    start = float(t[0]) + 0.5 * float((t - t[0] - dt * slots).min() + (t - t[0] - dt * slots).max())
    start = float(t[0]) if abs(start - t[0]) < 0.05 * dt else start
    columns = {k: _scatter(v, slots, n) for k, v in channels.items()}
    others = {k: _scatter(v, slots, n) for k, v in extra.items()}
    return [
        Segment(
            t=np.asarray(start + dt * np.arange(n), dtype=np.float64),
            channels=columns,
            flight=flight,
            extra=others,
            step=float(f"{dt:.12g}"),
        )
    ]


def _scatter(values: npt.NDArray[Kind], slots: npt.NDArray[np.int64], n: int) -> npt.NDArray[Kind]:
    out = np.full(n, np.nan if values.dtype.kind == "f" else "", dtype=values.dtype)
    out[slots] = values
    return out


def _resampled(
    part: Part, first: float, dt: float, step: float, flight: str, linear_hold: bool
) -> list[Segment]:
    """A stretch on a grid of `dt` from `first` on; `step` is the log's own sample time."""
    t, channels, extra = part
    n = int(np.floor((t[-1] - first) / dt + 1e-9)) + 1
    if n < 2:
        return []
    grid: FloatArray = np.asarray(first + dt * np.arange(n), dtype=np.float64)
    attitude = group_names("attitude")
    whole = all(k in channels for k in attitude)
    commands = set(command_names(channels))
    out: dict[str, FloatArray] = {}
    for name, values in channels.items():
        if whole and name in attitude:
            continue
        if name in commands and not linear_hold:
            sent = t[np.isfinite(values)]
            pace = float(np.median(np.diff(sent))) if sent.size > 1 else step
            out[name] = commands_at(t, values[:, None], grid, dt, pace)[:, 0]
            continue
        # A command that moves along a line is its mean over the row's step, where rows are averaged.
        ahead = 0.5 * dt if name in commands and dt > AVERAGE_FROM * step else 0.0
        out[name] = at_rows(t, values[:, None], grid + ahead, dt, sparse=name != "vbat")[:, 0]
    if whole:
        q = at_rows(t, np.stack([channels[k] for k in attitude], axis=1), grid, dt)
        q /= np.linalg.norm(q, axis=1, keepdims=True)
        out.update({k: q[:, j] for j, k in enumerate(attitude)})
    others = {k: held(t, v, grid) for k, v in extra.items()}
    step = float(f"{dt:.12g}")
    return [Segment(t=grid, channels=out, flight=flight, extra=others, step=step)]


def _with_drive(
    pieces: list[Segment], names: tuple[str, ...], max_gap: float
) -> tuple[list[Segment], list[str]]:
    """Over at most `max_gap` [s] fill in the commands `names`, or the rotor speeds that drive in
    their place; break the segments where they stay unknown.

    A line is drawn between rotor speeds, and between commands where a row is lost in which one was
    due. Commands that rows lack otherwise are held: none was sent.
    """
    if not names:
        return pieces, []
    measured = not command_names(names)
    out: list[Segment] = []
    filled = drawn = lost = 0
    for piece in pieces:
        values = piece.matrix(names)
        limit = max(round(min(max_gap / piece.dt, piece.n)), 1)  # infinite: no gap
        index = np.arange(piece.n)[:, None]
        known = np.isfinite(values)
        last = np.maximum.accumulate(np.where(known, index, -1), axis=0)
        usable = (last >= 0) & (index - last <= limit)
        carried = np.take_along_axis(values, np.maximum(last, 0), axis=0)
        following = np.minimum.accumulate(np.where(known, index, piece.n)[::-1], axis=0)[::-1]
        between = (following < piece.n) & (following - last <= limit + 1) & usable
        after = np.take_along_axis(values, np.minimum(following, piece.n - 1), axis=0)
        line = carried + (index - last) / np.maximum(following - last, 1) * (after - carried)
        if measured:
            usable = known | between
            carried = np.where(known, values, line)
        else:
            row_lost = np.asarray(np.isnan(piece.matrix(piece.names)).all(axis=1))
            apart = _rows_apart(known)
            due = last + (index - last) // apart * apart
            unknown = between & row_lost[due] & (due > last)
            line = np.take_along_axis(line, due, axis=0)
            carried = np.where(unknown, line, carried)
            drawn += int(unknown.any(axis=1).sum())
        filled += int((usable & ~known).any(axis=1).sum())
        good = usable.all(axis=1)
        lost += int((~good).sum())
        if (usable & ~known).any():
            piece = piece.replace(
                {n: np.where(usable[:, j], carried[:, j], np.nan) for j, n in enumerate(names)}
            )
        for a, b in runs(np.asarray(good)):
            if b - a >= 2:
                out.append(piece if (a, b) == (0, piece.n) else piece.rows(a, b))
            else:
                lost += 1
    notes = []
    if filled and measured:
        notes.append(f"rotor speeds interpolated over {filled} sample(s) without one")
    if drawn:
        notes.append(f"commands interpolated over {drawn} lost row(s)")
    if filled > drawn and not measured:
        notes.append(f"commands held over {filled - drawn} sample(s) without one")
    if lost:
        what = "rotor speeds are" if measured else "command is"
        notes.append(f"dropped {lost} sample(s) whose {what} not known")
    return out, notes


def _rows_apart(known: npt.NDArray[np.bool_]) -> npt.NDArray[np.int64]:
    """(K,) how many rows usually lie from one command to the next, of `known` (n, K)."""
    rows = [np.flatnonzero(column) for column in known.T]
    return np.array([int(np.median(np.diff(r))) if r.size > 1 else 1 for r in rows])


def _flight(raw: RawLog, pieces: list[Segment], notes: list[str], where: str) -> Flight:
    long = [p for p in pieces if p.n >= SHORT] or pieces
    if not long:
        raise DataError(
            "no stretch of samples with known commands",
            where=where,
            fix="log all commands (or all rotor speeds) at every row",
        )
    if len(long) < len(pieces):
        dropped = sum(p.n for p in pieces if p.n < SHORT)
        notes.append(
            f"dropped {len(pieces) - len(long)} stretch(es) of fewer than {SHORT} samples "
            f"({dropped} in all)"
        )
    kept = sum(p.n for p in long)
    missing = sum(int(np.isnan(p.matrix(p.names)).any(axis=1).sum()) for p in long)
    notes.append(
        f"kept {kept} samples in {len(long)} segment(s), {missing} of them with missing cells"
    )
    return Flight(
        name=raw.flight,
        segments=tuple(long),
        source=raw.source,
        sha256=raw.sha256,
        notes=tuple(notes),
        noncausal=raw.noncausal,
        recipes=raw.recipes,
        removed=raw.removed,
        fingerprint=raw.fingerprint,
    )
