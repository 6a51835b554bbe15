"""Samples of one stream on the rows of another: what is interpolated, averaged, held, or left
missing.

Measurements of about the rows' rate are interpolated linearly, faster ones averaged around the row,
slower ones stand only in the row next to each sample, moved along the line through their
neighbours. A command is the mean of what was held until the next row. Nothing is carried over a
gap.
"""

from __future__ import annotations

import numpy as np

from greybox.data.raw import FloatArray
from greybox.data.resampling import AVERAGE_FROM, STRETCH, continuous_signs
from greybox.symbolic import BoolArray

COMMAND_AGE = 0.1
"""A command is held for at most this time [s], or five of its steps where that is longer."""


def at_rows(
    t: FloatArray,
    values: FloatArray,
    rows: FloatArray,
    row_step: float,
    step: float | None = None,
    *,
    sparse: bool = True,
) -> FloatArray:
    """Samples (N, K) at increasing `t` on the rows (M,), as the head of this file says; NaN where
    nothing is known."""
    known = np.isfinite(values).all(axis=1)
    t, values = t[known], values[known]
    out = np.full((rows.size, values.shape[1]), np.nan)
    if t.size == 0:
        return out
    if values.shape[1] == 4:
        values, _ = continuous_signs(values)
    if t.size == 1:
        return _beside(t, values, rows, row_step, np.inf)
    own = max(float(np.median(np.diff(t))), step if step is not None and np.isfinite(step) else 0.0)
    if sparse and own > AVERAGE_FROM * row_step:
        return _beside(t, values, rows, row_step, STRETCH * own)
    i = np.clip(np.searchsorted(t, rows, side="right") - 1, 0, t.size - 2)
    joined = np.diff(t) <= STRETCH * own
    weight = (rows - t[i]) / (t[i + 1] - t[i])
    there = joined[i] | (np.abs(weight) < 1e-9) | (np.abs(weight - 1) < 1e-9)
    line = (1 - weight[:, None]) * values[i] + weight[:, None] * values[i + 1]
    if row_step > AVERAGE_FROM * own:
        mean, cover = _means(t, values, joined, rows, row_step)
        # Of a window with a hole, or at an end, the mean would be that of another time.
        whole = cover > (1 - 1e-9) * row_step
        line = np.where((whole | ~there)[:, None], mean, line)
        there |= cover >= 0.5 * row_step
    good = there & (rows >= t[0] - 0.5 * own) & (rows <= t[-1] + 0.5 * own)
    out[good] = line[good]
    return out


def _means(
    t: FloatArray, values: FloatArray, joined: BoolArray, rows: FloatArray, width: float
) -> tuple[FloatArray, FloatArray]:
    """(means (M, K) of the piecewise linear signal over `width` around every row, of the steps that
    are `joined` (N - 1,); how much of it these cover, (M,))."""
    step = np.where(joined, np.diff(t), 0.0)
    slope = np.diff(values, axis=0) / np.diff(t)[:, None]
    area = 0.5 * (values[1:] + values[:-1]) * step[:, None]
    whole = np.vstack([np.zeros(values.shape[1]), np.cumsum(area, axis=0)])
    known = np.concatenate([[0.0], np.cumsum(step)])

    def up_to(at: FloatArray) -> tuple[FloatArray, FloatArray]:
        at = np.clip(at, t[0], t[-1])
        i = np.clip(np.searchsorted(t, at, side="right") - 1, 0, t.size - 2)
        s = np.where(joined[i], at - t[i], 0.0)
        more = s[:, None] * values[i] + 0.5 * s[:, None] ** 2 * slope[i]
        return whole[i] + more, known[i] + s

    (area1, known1), (area0, known0) = up_to(rows + 0.5 * width), up_to(rows - 0.5 * width)
    cover = known1 - known0
    return (area1 - area0) / np.maximum(cover, 1e-12)[:, None], cover


def _beside(
    t: FloatArray, values: FloatArray, rows: FloatArray, row_step: float, reach: float
) -> FloatArray:
    """A slow stream: each sample in the row next to it, at the row's time on the line through its
    neighbours."""
    out = np.full((rows.size, values.shape[1]), np.nan)
    order = np.argsort(rows, kind="stable")
    sorted_rows = rows[order]
    right = np.clip(np.searchsorted(sorted_rows, t), 1, rows.size - 1)
    nearer = np.abs(sorted_rows[right - 1] - t) <= np.abs(sorted_rows[right] - t)
    row = order[np.where(nearer, right - 1, right)]
    away = rows[row] - t
    keep = np.abs(away) <= 0.75 * row_step
    j = np.arange(t.size)
    toward = np.where(away >= 0, 1, -1)
    moved, done = values.copy(), np.zeros(t.size, dtype=bool)
    # The neighbour on the row's side; where there is none (ends, gaps) the line through the other
    # one.
    for side in (toward, -toward):
        other = np.clip(j + side, 0, t.size - 1)
        span = t[other] - t
        good = ~done & (span != 0) & (np.abs(span) <= reach)
        moved[good] += (away / np.where(good, span, 1.0))[good, None] * (values[other] - values)[
            good
        ]
        done |= good
    out[row[keep]] = moved[keep]
    return out


def commands_at(
    t: FloatArray, values: FloatArray, rows: FloatArray, row_step: float, step: float
) -> FloatArray:
    """Mean over each row's step (to the next row) of commands (N, K) that are held from their
    stamps on; NaN before the first and where the last one is too old.
    """
    known = np.isfinite(values).all(axis=1)
    t, values = t[known], values[known]
    out = np.full((rows.size, values.shape[1]), np.nan)
    if t.size == 0:
        return out
    following = np.concatenate([rows[1:], [rows[-1] + row_step]])
    end = np.where(following > rows, np.minimum(following, rows + 1.5 * row_step), rows + row_step)
    area = np.vstack(
        [np.zeros(values.shape[1]), np.cumsum(values[:-1] * np.diff(t)[:, None], axis=0)]
    )

    def up_to(at: FloatArray) -> FloatArray:
        i = np.clip(np.searchsorted(t, at, side="right") - 1, 0, t.size - 1)
        return area[i] + values[i] * (at - t[i])[:, None]

    i = np.searchsorted(t, rows, side="right") - 1
    limit = max(COMMAND_AGE, 5 * step) + row_step
    begin = np.maximum(rows, t[0])
    # What was sent too long ago no longer counts, from the next command on the row does.
    stale = begin - t[np.clip(i, 0, t.size - 1)] > limit
    begin = np.where(stale, np.minimum(t[np.clip(i + 1, 0, t.size - 1)], end), begin)
    mean = (up_to(end) - up_to(begin)) / np.maximum(end - begin, 1e-12)[:, None]
    last = np.searchsorted(t, end, side="left") - 1
    age = end - t[np.clip(last, 0, t.size - 1)]
    good = (end - begin >= 0.5 * (end - rows)) & (last >= 0) & (age <= limit)
    # A row whose step holds one command takes it exactly, not as a quotient.
    single = good & (i >= 0) & (i == last)
    # Rounding leaves no command beyond all that were sent.
    out[good] = np.clip(mean, values.min(axis=0), values.max(axis=0))[good]
    out[single] = values[i[single]]
    return out
