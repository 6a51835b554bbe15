"""Thin out long time series for a plot and keep every peak."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from greybox.errors import DataError
from greybox.symbolic import FloatArray


def min_max(
    t: npt.ArrayLike, values: npt.ArrayLike, *, buckets: int = 300
) -> tuple[FloatArray, FloatArray]:
    """(t, values) with at most about two points per bucket: the least and the greatest, in their
    order in time.

    `t` (N,) increasing [s], `values` (N,). NaN breaks the line and so does a time step above three
    median ones: a row of NaN marks each break. Raises `DataError` for arrays that do not match.
    """
    x, y = np.asarray(t, dtype=np.float64), np.asarray(values, dtype=np.float64)
    if x.ndim != 1 or x.shape != y.shape:
        raise DataError("decimation needs t (N,) and values (N,)", got=f"{x.shape} and {y.shape}")
    if buckets < 1:
        raise DataError("decimation needs at least one bucket", got=str(buckets))
    seen = np.isfinite(y)
    if not seen.any():
        return np.zeros(0), np.zeros(0)
    steps = np.diff(x)
    gap = (
        np.concatenate([[False], steps > 3.0 * np.median(steps)])
        if len(steps)
        else np.zeros(len(x), dtype=bool)
    )
    # A stretch ends at a missing sample and at a gap; every sample knows its stretch.
    stretch = np.cumsum(gap | ~seen)
    index = np.flatnonzero(seen)
    if len(index) > 2 * buckets:
        cell = np.minimum((index * buckets) // len(x), buckets - 1)
        order = np.lexsort((y[index], cell))
        first = np.flatnonzero(np.diff(cell[order], prepend=-1))
        last = np.append(first[1:], len(order)) - 1
        ends = np.array([index[0], index[-1]])
        index = np.unique(np.concatenate([index[order[first]], index[order[last]], ends]))
    breaks = np.flatnonzero(np.diff(stretch[index])) + 1
    return np.insert(x[index], breaks, np.nan), np.insert(y[index], breaks, np.nan)
