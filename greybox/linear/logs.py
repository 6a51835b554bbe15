"""From log files to records: any CSV with a time column, any numeric columns as inputs and outputs.

A channel may also be a sum of columns, `roll=u4+u3-u2-u1` or `force=0.5*u1+0.5*u2`: the way to make
the decoupled axes of a multirotor, or a difference of two sensors.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from greybox.data.channel import channel, is_canonical
from greybox.data.conditioning import condition
from greybox.data.dataset import Dataset, Flight
from greybox.data.logs import read_possible
from greybox.data.raw import RawLog, is_numeric
from greybox.data.readers import LogMapping
from greybox.data.segment import Segment
from greybox.errors import DataError, UnknownNameError
from greybox.linear.records import Record, split_at_missing
from greybox.model.vehicle import Vehicle
from greybox.symbolic import FloatArray, Signal

NAMES_COLUMNS = "--vehicle V.toml, which says what the log calls it"
_TERM = re.compile(
    r"([+-])\s*(?:((?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:e[+-]?[0-9]+)?)\s*\*\s*)?([A-Za-z_][\w.]*)",
    re.IGNORECASE,
)


@dataclass(frozen=True, kw_only=True)
class ChannelSpec:
    """A channel of the model: its name and the columns it is the weighted sum of."""

    name: str
    terms: tuple[tuple[float, str], ...]

    @staticmethod
    def parse(text: str) -> ChannelSpec:
        """`p` or `name=a+2*b-c`; without `=` what is no sum is the name of a column, however it is
        spelt. Raises `DataError` for anything else."""
        name, named, formula = text.partition("=")
        name, formula = name.strip(), (formula or name).strip()
        signed = formula if formula[:1] in "+-" else "+" + formula
        terms, end = [], 0
        for match in _TERM.finditer(signed):
            if signed[end : match.start()].strip():
                break
            sign, factor, column = match.groups()
            terms.append((float(factor or 1.0) * (-1.0 if sign == "-" else 1.0), column))
            end = match.end()
        if name and not named and (not terms or signed[end:].strip()):
            return ChannelSpec(name=name, terms=((1.0, name),))
        if not name or not terms or signed[end:].strip():
            raise DataError(
                f"channel '{text}'",
                expected="a column name, or NAME=a+2*b-c",
                fix="quote it for the shell",
            )
        return ChannelSpec(name=name, terms=tuple(terms))

    @property
    def signal(self) -> Signal:
        """Name with unit where the log contract knows it, else "1"; what it means where it is more
        than a column of its name."""
        return self.made_of({})

    def made_of(self, recipes: Mapping[str, str]) -> Signal:
        """The same, with how the columns were made of what the logs hold."""
        own = len(self.terms) == 1 and self.terms[0][1] == self.name
        unit = channel(self.name).unit if own and is_canonical(self.name) else "1"
        if own and self.terms[0][0] == 1.0:
            return Signal(name=self.name, unit=unit, meaning=recipes.get(self.name, ""))
        sums = "".join(
            f" {'-' if w < 0 else '+'} {'' if abs(w) == 1.0 else f'{abs(w):g} '}{c}"
            for w, c in self.terms
        )
        made = [f"{c} = {recipes[c]}" for _, c in self.terms if c in recipes]
        text = sums[3:] if sums.startswith(" + ") else f"-{sums[3:]}"
        return Signal(name=self.name, unit=unit, meaning="; ".join([text, *made]))


def parse_channels(text: str, what: str) -> tuple[ChannelSpec, ...]:
    """A comma-separated list of channels. Raises `DataError` for an empty list or a name given
    twice."""
    specs = tuple(ChannelSpec.parse(part) for part in text.split(",") if part.strip())
    names = [s.name for s in specs]
    if not specs and what == "outputs":
        raise DataError("no outputs named", fix="--outputs p,q,r")
    double = sorted({n for n in names if names.count(n) > 1})
    if double:
        raise DataError(f"{what} given twice: {', '.join(double)}", fix="name every channel once")
    return specs


@dataclass(frozen=True, kw_only=True)
class Logs:
    """Records of several logs with one sample time [s], the flights they came from, and notes on
    what was done."""

    records: tuple[Record, ...]
    dt: float
    flights: tuple[Flight, ...]
    notes: tuple[str, ...]

    @property
    def recipes(self) -> dict[str, str]:
        """How columns were made of what the logs hold."""
        return Dataset(flights=self.flights).recipes


def read_records(
    paths: Sequence[str | os.PathLike[str]],
    inputs: Sequence[ChannelSpec],
    outputs: Sequence[ChannelSpec],
    vehicle: Vehicle | None = None,
    *,
    rate: float | None = None,
    trim: bool | None = None,
    hold: int = 5,
    bridge: int = 50,
    mapping: str | os.PathLike[str] | LogMapping | None = None,
) -> Logs:
    """Read logs into records. With a vehicle file its `[columns]` apply and the airborne part is
    kept (`trim`).

    Inputs that miss for at most `hold` samples are held; longer holes, and holes of over `bridge`
    samples in all outputs, end a record (with `bridge` 0 every lost row does, which keeps the fit
    on its fast path; pieces of fewer than 50 samples are then dropped). Raises `DataError` and
    `UnknownNameError` (column not in the log, text, other sample time).
    """
    records: list[Record] = []
    flights, notes = [], []
    dt = None
    for path in paths:
        raw = with_columns(
            read_possible(path, vehicle, mapping=mapping),
            (*inputs, *outputs),
            os.fspath(path),
            named=vehicle is not None or mapping is not None,
        )
        cut = vehicle is not None if trim is None else trim
        flight = condition(raw, vehicle, rate=rate, trim=cut, where=os.fspath(path))
        if dt is None:
            dt = flight.dt
        elif abs(flight.dt - dt) > 1e-6 * dt:
            raise DataError(
                f"sample time {flight.dt:g} s",
                where=os.fspath(path),
                expected=f"{dt:g} s as in the first log",
                fix="resample all logs with --rate",
            )
        notes += [f"{flight.name}: {n}" for n in flight.notes]
        flights.append(flight)
        pieces, said = _records(flight, inputs, outputs, hold, bridge)
        records += pieces
        notes += said
    if not records or dt is None:
        raise DataError(
            "no usable samples in the logs",
            fix="check that inputs and outputs were logged at one time",
        )
    return Logs(records=tuple(records), dt=dt, flights=tuple(flights), notes=tuple(notes))


def demand_alike(train: Logs, test: Logs) -> None:
    """Raise `DataError` for test logs of another sample time, and for a log in both."""
    if abs(test.dt - train.dt) > 1e-6 * train.dt:
        raise DataError(
            f"test logs have sample time {test.dt:g} s", expected=f"{train.dt:g} s", fix="--rate"
        )
    same = {f.sha256 for f in train.flights} & {f.sha256 for f in test.flights} - {""}
    if same:
        twice = next(f.name for f in test.flights if f.sha256 == min(same))
        raise DataError(
            f"log '{twice}' is both train and test", fix="give every log to one of the two"
        )


def _records(
    flight: Flight,
    inputs: Sequence[ChannelSpec],
    outputs: Sequence[ChannelSpec],
    hold: int,
    bridge: int,
) -> tuple[list[Record], list[str]]:
    """(records of a flight, what was held or dropped in words); see `read_records`."""
    records: list[Record] = []
    notes: list[str] = []
    total_held = 0
    for i, segment in enumerate(flight.segments):
        u = (
            np.column_stack([_mixed(segment, s) for s in inputs])
            if inputs
            else np.zeros((segment.n, 0))
        )
        y = np.column_stack([_mixed(segment, s) for s in outputs])
        u, held = _held(u, hold)
        total_held += held
        name = flight.name if len(flight.segments) == 1 else f"{flight.name}#{i + 1}"
        pieces = split_at_missing(u, y, name=name, longest=bridge)
        if len(pieces) > 1:
            kept = [q for q in pieces if len(q) >= 50]
            lost = sum(len(q) for q in pieces) - sum(len(q) for q in kept)
            notes.append(
                f"{name}: cut at missing rows into {len(kept)} records; {lost} samples in "
                "short pieces dropped"
            )
            pieces = kept
        records += pieces
    if total_held:
        notes.append(
            f"{flight.name}: {total_held} missing input samples held at the value before them"
        )
    return records, notes


def with_columns(
    raw: RawLog, specs: Sequence[ChannelSpec], where: str, *, named: bool = True
) -> RawLog:
    """The raw log with every needed column among its channels, so that conditioning interpolates
    it. `named`: a vehicle or mapping file said what the columns are called.

    Raises `UnknownNameError` for a column that the log has not, `DataError` for text, infinite or
    no values.
    """
    wanted = {column for spec in specs for _, column in spec.terms}
    channels = {}
    for name in sorted(wanted):
        if name in raw.channels:
            channels[name] = raw.channels[name]
            continue
        if name not in raw.extra:
            known = [*raw.channels, *raw.extra]
            fix = NAMES_COLUMNS if is_canonical(name) and not named else None
            raise UnknownNameError("column", name, known, where=where, fix=fix)
        column = raw.extra[name]
        if not is_numeric(column):
            raise DataError(
                f"column '{name}' is not numeric", where=where, fix="leave missing cells empty"
            )
        if np.isinf(column).any():
            raise DataError(
                f"column '{name}' has infinite values", where=where, fix="leave bad cells empty"
            )
        channels[name] = column
    empty = [n for n, v in channels.items() if not np.isfinite(v).any()]
    if empty:
        raise DataError(
            f"column '{empty[0]}' holds no value", where=where, fix="name another column"
        )
    # What only conditioning needs (height and commands tell the airborne part) stays; the rest is
    # dropped.
    kept = {n: v for n, v in raw.channels.items() if n not in channels}
    # The reader calls columns unused that are no channels of a multirotor; here the channels are
    # the user's.
    notes = tuple(n for n in raw.notes if not n.startswith("columns kept but not used"))
    unused = [n for n in raw.extra if n not in channels]
    if unused:
        notes = (*notes, "columns not used: " + ", ".join(unused))
    return replace(raw, channels={**kept, **channels}, extra={}, notes=notes)


def _mixed(segment: Segment, spec: ChannelSpec) -> FloatArray:
    return np.asarray(
        sum(weight * segment.column(column) for weight, column in spec.terms), dtype=np.float64
    )


def _held(u: FloatArray, longest: int) -> tuple[FloatArray, int]:
    """Missing inputs replaced by the last known value, over at most `longest` samples; and how
    many."""
    if np.isfinite(u).all():
        return u, 0
    out, count = u.copy(), 0
    for j in range(u.shape[1]):
        index = np.arange(len(u))
        last = np.maximum.accumulate(np.where(np.isfinite(u[:, j]), index, -1))
        usable = (last >= 0) & (index - last <= longest)
        fill = usable & ~np.isfinite(u[:, j])
        out[fill, j] = u[last[fill], j]
        count += int(fill.sum())
    return out, count
