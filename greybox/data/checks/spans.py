"""Where increments are taken: between samples of the slower of two streams, whatever its pace.

The increment of the faster one is its integral between the same instants, moved by a delay. Streams
of one rate have spans that start at every eighth of their length.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from greybox.data.checks.signals import BoolArray, FloatArray, IntArray, Integral, pace

STARTS = 8
"""Spans begin at most this often within the length of one."""
NEAR = 4
"""A span may be longer or shorter by one part in so many."""


def length_of(wanted: float, *, between: FloatArray, of: FloatArray) -> int:
    """Length [rows] of spans `between` samples (N, k), about the one wanted: twice the pace of
    these at least, and four times that `of` the stream which is integrated."""
    return max(1, round(wanted), 2 * pace(between), 4 * pace(of))


@dataclass(frozen=True, kw_only=True, eq=False)
class Spans:
    """M spans between samples: the increment of a track (N, k) over one is the sum of its values at
    `rows` (M, P), each times its weight, `weights` (M, P). `length` [rows] is the usual one.

    `centred`: sensors have biases, so that what a constant rate would make is left out.
    """

    rows: IntArray
    weights: FloatArray
    length: int
    centred: bool = False

    def __len__(self) -> int:
        return int(self.rows.shape[0])

    def of(self, track: FloatArray) -> FloatArray:
        """Increments (M, k) of a track (N, k), missing where one of its samples is."""
        return np.asarray(np.einsum("mp,mpk->mk", self.weights, track[self.rows]))

    def known(self, of: Integral, lag: int) -> BoolArray:
        """Spans (M,) over which nothing of an integral is missing, `lag` rows before."""
        return of.known(self._columns[0] - lag, self._columns[-1] - lag)

    def over(self, of: Integral, lag: int = 0) -> FloatArray:
        """Increments (M, k) of an integral, `lag` rows before these spans, missing where it is."""
        out = np.full((len(self), of.total.shape[1]), np.nan)
        there = np.flatnonzero(self.known(of, lag))
        out[there] = self.among(of, lag, there)
        return out

    def among(self, of: Integral, lag: int, which: IntArray) -> FloatArray:
        """Increments (len(which), k) of an integral, `lag` rows before those of these spans over
        which nothing of it is missing then."""
        # `take` is four times as fast as an index here.
        first, *more = (of.total.take(rows.take(which) - lag, axis=0) for rows in self._columns)
        if self._between_two:
            return np.asarray(more[0] - first)
        out = self.weights[:, 0].take(which)[:, None] * first
        for k, part in enumerate(more, 1):
            out += self.weights[:, k].take(which)[:, None] * part
        return out

    @functools.cached_property
    def _columns(self) -> tuple[IntArray, ...]:
        """The columns of `rows`, each in one piece."""
        return tuple(np.ascontiguousarray(self.rows.T))

    @functools.cached_property
    def _between_two(self) -> bool:
        """Whether an increment is the later value less the earlier one."""
        return self.rows.shape[1] == 2 and bool((self.weights == (-1.0, 1.0)).all())

    @functools.cached_property
    def rates(self) -> FloatArray:
        """What a constant rate makes of every increment (M,)."""
        since = (self.rows - self.rows[:, :1]).astype(np.float64)
        if self.rows.shape[1] > 2:
            since *= 0.5 * since
        return np.asarray((self.weights * since).sum(axis=1))

    def without_bias(self, values: FloatArray, which: IntArray) -> FloatArray:
        """Increments (len(which), k) of these spans, none missing, without what a constant rate
        explains of them."""
        if not self.centred:
            return values
        rate = self.rates.take(which)
        share = rate @ values / max(float(rate @ rate), 1e-300)
        out = np.empty_like(values)
        for k, part in enumerate(share.tolist()):  # long columns: products with three are slow
            np.multiply(rate, part, out=out[:, k])
        return np.subtract(values, out, out=out)


def spans(
    samples: FloatArray, length: int, *, window: int = 0, dt: float = 1.0, centred: bool = False
) -> Spans:
    """Spans of about `length` rows between `samples` (N, k); with a `window` [rows of `dt`] those of
    the change of their mean rate over such a time."""
    rows = np.flatnonzero(np.isfinite(samples).all(axis=1))
    starts = rows[np.diff(rows // max(1, length // STARTS), prepend=-1) > 0]
    wanted = [0, window, length, length + window] if window else [0, length]
    at, good = [starts], np.ones(starts.size, dtype=bool)
    for ahead in wanted[1:]:
        found = _nearest(rows, starts + ahead)
        good &= (np.abs(found - starts - ahead) <= length // NEAR) & (found >= at[-1])
        at.append(found)
    good &= (at[1] > at[0]) & (at[-1] > at[-2])
    ends = np.stack(at, axis=1)[good]
    weights = np.tile([-1.0, 1.0], (len(ends), 1))
    if window:
        rates = 1.0 / dt / np.diff(ends, axis=1)[:, [0, 0, 2, 2]]
        weights = rates * np.array([1.0, -1.0, -1.0, 1.0])
    return Spans(rows=ends, weights=weights, length=length, centred=centred)


def _nearest(rows: IntArray, wanted: IntArray) -> IntArray:
    """The one of increasing rows that is next to each wanted one."""
    if not rows.size:
        return wanted
    right = np.clip(np.searchsorted(rows, wanted), 0, rows.size - 1)
    left = np.maximum(right - 1, 0)
    nearer = np.abs(rows[left] - wanted) < np.abs(rows[right] - wanted)
    return np.where(nearer, rows[left], rows[right])
