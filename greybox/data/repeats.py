"""Samples of a slow stream that stand in every row: the first of them was measured, its repeats
were not.

A merged table often carries a value on until the next one comes. Such runs of exact repeats are all
of about one length. Those of a craft that stands still, or of a sensor with coarse steps, are not:
most of theirs are a single row.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from greybox.data.channel import group_names
from greybox.data.raw import RawLog
from greybox.symbolic import BoolArray, FloatArray, IntArray

MEASURED = ("attitude", "position", "velocity")
"""Groups whose repeats become missing."""
FEWEST = 20
"""Fewer runs than this tell no length."""
ALIKE = 0.8
"""Share of the runs that have about the usual length, of two rows or more ..."""
SLACK = 0.2
"""... within one row, or within this share of it."""
LATE = 4
"""Samples that may come late in a row; what stays longer stands still."""
SOME = 5
"""Runs of at least this many rows may also be two or three of them that are equal."""


@dataclass(frozen=True, kw_only=True)
class Held:
    """A group of channels whose samples are held over `rows` rows, which are `interval` [s]."""

    group: str
    names: tuple[str, ...]
    rows: int
    interval: float


def held_over(values: FloatArray) -> int:
    """Over how many rows the samples (N, k) of a stream are held; 1 where they are not."""
    new = np.flatnonzero((np.diff(values, axis=0) != 0.0).any(axis=1))
    if new.size <= FEWEST:
        return 1
    lengths = np.diff(new)
    usual = int(np.median(lengths))
    if usual < 2:
        return 1
    slack = max(1.0, SLACK * usual)
    whole = np.clip(np.rint(lengths / usual), 1, 3 if usual >= SOME else 1)
    alike = (lengths >= 2) & (np.abs(lengths - usual * whole) <= slack)
    return usual if alike.mean() >= ALIKE else 1


def held(raw: RawLog, group: str, names: tuple[str, ...]) -> Held | None:
    """How long the samples of these channels are held; None where they are not, or not all are
    there."""
    if not names or not all(n in raw.channels for n in names):
        return None
    values = np.column_stack([raw.channels[n] for n in names])
    known = np.isfinite(values).all(axis=1) & np.isfinite(raw.t)
    rows = held_over(values[known])
    if rows < 2:
        return None
    step = float(np.ptp(raw.t[known])) / (int(known.sum()) - 1)  # coarse stamps may be equal
    if step == 0.0:
        return None
    return Held(group=group, names=names, rows=rows, interval=rows * step)


def repeated(raw: RawLog) -> tuple[Held, ...]:
    """The measured groups whose samples are held over several rows."""
    found = [held(raw, group, group_names(group)) for group in MEASURED]
    return tuple(h for h in found if h is not None)


def without_repeats(raw: RawLog) -> RawLog:
    """`raw` with what only repeats the last sample of a slow stream as missing cells; its `notes`
    say so."""
    slow = repeated(raw)
    if not slow:
        return raw
    new: dict[str, FloatArray] = {}
    for one in slow:
        values = np.column_stack([raw.channels[n] for n in one.names])
        known = np.flatnonzero(np.isfinite(values).all(axis=1))
        same = (np.diff(values[known], axis=0) == 0.0).all(axis=1)
        since = _since_new(same)
        # a stream that stands still longer than samples come late goes on at its own pace
        again = (since >= LATE * one.rows) & (since % one.rows == 0)
        values[known[(since > 0) & ~again]] = np.nan
        new |= {n: values[:, i] for i, n in enumerate(one.names)}
    notes = tuple(f"{h.group}: {said(h)}" for h in slow)
    return replace(raw, channels={**raw.channels, **new}, notes=(*raw.notes, *notes))


def _since_new(same: BoolArray) -> IntArray:
    """Rows (N,) since the last that was not the same as the one before it (N - 1,)."""
    rows = np.arange(same.size + 1)
    new = np.concatenate([[True], ~same])
    return rows - np.maximum.accumulate(np.where(new, rows, 0))


def said(one: Held) -> str:
    """What is done with a group that is held."""
    return (
        f"every sample comes {one.rows} times: it is one at {1.0 / one.interval:.3g} Hz, of which "
        "the first counts"
    )
