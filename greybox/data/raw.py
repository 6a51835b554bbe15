"""RawLog: a log in canonical channels on its own, unchecked clock, and what was removed from
one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TypeGuard

import numpy as np
import numpy.typing as npt

from greybox.data.fingerprint import LogFile
from greybox.errors import DataError

FloatArray = npt.NDArray[np.float64]
Column = npt.NDArray[np.generic]
"""A column of a log as it came: numbers, or text."""


def is_numeric(column: Column) -> TypeGuard[FloatArray]:
    """Whether a column holds numbers."""
    return column.dtype.kind == "f"


LARGEST = float(np.finfo(np.float32).max)
"""No sensor writes more; the square of more than its square overflows."""
SMALLEST = float(np.finfo(np.float32).tiny)
"""No sensor writes less but zero, whose square is no number either."""


@dataclass(frozen=True, kw_only=True)
class Removed:
    """Samples of one channel group in one flight that were taken as missing."""

    flight: str
    channels: tuple[str, ...]
    count: int
    worst: float
    first_time: float
    reason: str

    def line(self) -> str:
        """For a terminal."""
        names = ", ".join(self.channels)
        return (
            f"{self.flight}: {self.count} sample(s) of {names} taken as missing ({self.reason}; "
            f"the worst {self.worst:.4g}, the first at t = {self.first_time:.2f} s)"
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class RawLog:
    """Canonical channels (SI, right signs) on the clock of the log, which may still jitter, stop or
    go back.

    `t` (N,) finite [s]; `channels` name -> (N,), NaN = missing; `extra` unknown columns as they
    came; `rows` (N,) line numbers in the file; `empty` canonical channels whose column holds no
    value; `recipes` how a channel was made of what the log holds; `notes` what the reader has to
    say; `removed` the samples that were taken as missing because no craft can have made them;
    `fingerprint` some of the samples of its file.
    """

    t: FloatArray
    channels: Mapping[str, FloatArray]
    extra: Mapping[str, Column]
    rows: npt.NDArray[np.int64]
    flight: str
    source: str
    sha256: str
    noncausal: frozenset[str] = frozenset()
    recipes: Mapping[str, str] = field(default_factory=dict)
    empty: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    removed: tuple[Removed, ...] = ()
    fingerprint: frozenset[str] = frozenset()

    @property
    def file(self) -> LogFile:
        """What tells it from other logs."""
        return LogFile(self.flight, self.sha256, self.fingerprint)

    @property
    def n(self) -> int:
        """Number of rows."""
        return int(self.t.size)


def measurable(raw: RawLog) -> RawLog:
    """`raw`, with values beyond `LARGEST` as the infinite ones, and below `SMALLEST` as the zeros,
    that they are for every sum of squares.

    Raises `DataError` for what is no log: no rows, no channels, columns of other lengths, stamps
    that are no numbers.
    """
    where = f"flight {raw.flight}"
    if not raw.n or not raw.channels:
        raise DataError(
            f"a log without {'channels' if raw.n else 'rows'}",
            where=where,
            fix="pass a log of a flight",
        )
    wrong = sorted(n for n, v in raw.channels.items() if v.shape != raw.t.shape)
    if wrong or raw.rows.shape != raw.t.shape:
        raise DataError(
            f"not one value per time stamp: {', '.join(wrong or ['rows'])}",
            where=where,
            expected=f"{raw.n}",
        )
    # A clock is no better than its steps: sums of stamps must be numbers, too.
    bad = np.flatnonzero(~(np.abs(raw.t) <= LARGEST))
    if bad.size:
        raise DataError(
            f"{bad.size} time stamp(s) that are no numbers",
            where=f"{where}, row {raw.rows[bad[0]]}",
            expected="finite seconds",
            got=f"{raw.t[bad[0]]:.4g}",
            fix="leave these rows out",
        )
    huge = {n: np.abs(v) > LARGEST for n, v in raw.channels.items()}
    new = {
        n: np.where(at, np.copysign(np.inf, raw.channels[n]), raw.channels[n])
        for n, at in huge.items()
        if at.any()
    }
    for name, values in raw.channels.items():
        nothing = (values != 0) & (np.abs(values) < SMALLEST)
        if nothing.any():
            new[name] = np.where(nothing, 0.0, new.get(name, values))
    return replace(raw, channels={**raw.channels, **new}) if new else raw
