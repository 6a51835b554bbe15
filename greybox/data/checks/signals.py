"""Small signal tools of the checks: smoothing, derivatives, shifts and correlations that leave
missing samples out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from greybox.data.resampling import continuous_signs
from greybox.frames import numeric

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

MINIMUM = 10
"""Fewer samples than this are not correlated."""


def smoothed(values: FloatArray, half: int) -> FloatArray:
    """Mean over 2 half + 1 samples, (N, k); missing where one of them is."""
    width = 2 * half + 1
    out = np.full_like(values, np.nan)
    if half == 0 or values.shape[0] < width:
        return values.copy() if half == 0 else out
    known = np.isfinite(values)
    total = np.cumsum(
        np.vstack([np.zeros((1, values.shape[1])), np.where(known, values, 0.0)]), axis=0
    )
    count = np.cumsum(np.vstack([np.zeros((1, values.shape[1])), known.astype(np.float64)]), axis=0)
    mean = (total[width:] - total[:-width]) / width
    out[half:-half] = np.where(count[width:] - count[:-width] == width, mean, np.nan)
    return out


def derivative(values: FloatArray, dt: float, half: int) -> FloatArray:
    """Central difference over 2 half samples, (N, k) per second."""
    out = np.full_like(values, np.nan)
    if values.shape[0] > 2 * half:
        out[half:-half] = (values[2 * half :] - values[: -2 * half]) / (2 * half * dt)
    return out


BRIDGED = 8
"""Gaps of up to this part of the time over which is integrated are bridged, ..."""
OWN_PACE = 1.5
"""... and those of up to this many usual steps of a stream that is slower than the rows."""


def pace(values: FloatArray) -> int:
    """Usual number of rows from one sample of a stream (N, k) to the next."""
    rows = np.flatnonzero(np.isfinite(values).all(axis=1))
    return max(1, round(float(np.median(np.diff(rows))))) if rows.size > 1 else 1


def joined_up(values: FloatArray, most: int = 0) -> FloatArray:
    """Values (N, k) on the lines between those that are known, over at most `most` missing samples
    or over the stream's own pace."""
    return bridged(values, max(most, int(OWN_PACE * pace(values)) - 1))


def attitude_joined_up(quaternions: FloatArray, most: int = 0) -> FloatArray:
    """Quaternions (N, 4) on the lines between those that are known, as `joined_up`."""
    out = joined_up(continuous_signs(quaternions)[0], most)
    return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))


@dataclass(frozen=True, kw_only=True, eq=False)
class Integral:
    """Integral (N, k) of a stream from the first row on, missing samples as zero, and how many
    steps are `lost` (N,) before each row."""

    total: FloatArray
    lost: npt.NDArray[np.int64]

    def known(self, first: IntArray, last: IntArray) -> BoolArray:
        """Whether nothing is missing from each row to the other; they may lie outside."""
        inside = (first >= 0) & (last < self.lost.size)
        if not self.lost[-1]:
            return np.asarray(inside)
        before, after = (self.lost.take(r, mode="clip") for r in (first, last))
        return np.asarray(inside & (before == after))


def integral(values: FloatArray, dt: float, most: int, times: int = 1) -> Integral:
    """Values (N, k) integrated once or twice, across gaps of at most `most` samples, or of the
    stream's own pace, as those of a line."""
    total = joined_up(values, most)
    there = np.asarray(np.isfinite(total).all(axis=1))
    there = there[1:] & there[:-1]
    lost = np.concatenate([[0], np.cumsum(~there)])
    for _ in range(times):
        steps = np.where(there[:, None], 0.5 * (total[1:] + total[:-1]) * dt, 0.0)
        total = np.vstack([np.zeros((1, steps.shape[1])), np.cumsum(steps, axis=0)])
        there = np.ones_like(there)
    return Integral(total=total, lost=lost)


def bridged(values: FloatArray, most: int) -> FloatArray:
    """Values (N, k) with lines drawn over at most `most` missing samples between known ones."""
    out = values.copy()
    rows = np.arange(len(values))
    for column in out.T:
        known = np.isfinite(column)
        if known.all() or not known.any():
            continue
        before = np.maximum.accumulate(np.where(known, rows, -1))
        after = np.minimum.accumulate(np.where(known, rows, len(rows))[::-1])[::-1]
        short = ~known & (before >= 0) & (after < len(rows)) & (after - before <= most + 1)
        column[short] = np.interp(rows[short], rows[known], column[known])
    return out


def turned(how: str, quaternions: FloatArray, vectors: FloatArray) -> FloatArray:
    """Vectors (N, 3) through `rotate` (body to world) or `rotate_inverse` of quaternions (N, 4)."""
    out = np.full_like(vectors, np.nan)
    known = np.isfinite(quaternions).all(axis=1) & np.isfinite(vectors).all(axis=1)
    if known.any():
        out[known] = numeric(how, quaternions[known], vectors[known])
    return out


def turns(quaternions: FloatArray, n: int) -> FloatArray:
    """Rotation vector (N - n, 3) [rad] in body axes over n samples from each on, of quaternions (N,
    4)."""
    return turns_between(quaternions[: max(quaternions.shape[0] - n, 0)], quaternions[n:])


def turns_between(before: FloatArray, after: FloatArray) -> FloatArray:
    """Rotation vector (N, 3) [rad] in body axes from the one attitude to the other, (N, 4) each."""
    out = np.full((before.shape[0], 3), np.nan)
    known = np.isfinite(before).all(axis=1) & np.isfinite(after).all(axis=1)
    if known.any():
        out[known] = numeric("difference", before[known], after[known])
    return out


def centred(values: FloatArray) -> FloatArray:
    """Columns (N, k) without their means."""
    known = np.isfinite(values).all(axis=1)
    return values - values[known].mean(axis=0) if known.any() else values


def shifted(values: FloatArray, rows: int) -> FloatArray:
    """out[k] = values[k - rows]: positive = later; missing at the rim."""
    out = np.full_like(values, np.nan)
    n = values.shape[0]
    if rows >= n or -rows >= n:
        return out
    if rows > 0:
        out[rows:] = values[:-rows]
    elif rows < 0:
        out[:rows] = values[-rows:]
    else:
        out[:] = values
    return out


def attitude_rate(quaternions: FloatArray, dt: float, half: int) -> FloatArray:
    """Body rate (N, 3) [rad/s] from quaternions (N, 4): the turn over 2 half samples, divided by
    its time."""
    out = np.full((quaternions.shape[0], 3), np.nan)
    if quaternions.shape[0] > 2 * half:
        out[half:-half] = turns(quaternions, 2 * half) / (2 * half * dt)
    return out


def products(a: FloatArray, b: FloatArray, lags: npt.NDArray[np.int64]) -> FloatArray:
    """Correlations (L, k, k) of the columns of a (N, k) with those of b moved later by each lag.

    Normalised so that the trace of a matrix is the correlation of all columns together, and that of
    the matrix with its columns exchanged or turned round the correlation with b exchanged or turned
    round. Zero where too little is known.
    """
    n, k = a.shape
    out = np.zeros((lags.size, k, k))
    known_a, known_b = (
        np.asarray(np.isfinite(a).all(axis=1)),
        np.asarray(np.isfinite(b).all(axis=1)),
    )
    for i, lag in enumerate(lags.tolist()):
        first, last = max(lag, 0), min(n, n + lag)
        if last - first < MINIMUM:
            continue
        x, y = a[first:last], b[first - lag : last - lag]
        known = known_a[first:last] & known_b[first - lag : last - lag]
        if int(known.sum()) < MINIMUM:
            continue
        x, y = x[known], y[known]
        x, y = x - x.mean(axis=0), y - y.mean(axis=0)
        size = float(np.sqrt((x**2).sum() * (y**2).sum()))
        if size > 0:
            out[i] = x.T @ y / size
    return out


def windowed(
    a: FloatArray,
    b: FloatArray,
    lags: npt.NDArray[np.int64],
    starts: npt.NDArray[np.int64],
    length: int,
) -> FloatArray:
    """Correlations (W, L) of all columns of a (N, k) together with those of b moved later by each
    lag, in windows of `length` rows from `starts` (W,) on. Zero where too little is known."""
    out = np.zeros((starts.size, lags.size))
    if not starts.size:
        return out
    edges = np.unique(np.concatenate([starts, starts + length]))
    first, last = np.searchsorted(edges, starts), np.searchsorted(edges, starts + length)

    def within(values: FloatArray) -> FloatArray:
        """Sums over the windows: of the pieces between edges, which are few."""
        pieces = np.add.reduceat(values[: edges[-1]], edges[:-1], axis=0)
        total = np.vstack([np.zeros((1, values.shape[1])), np.cumsum(pieces, axis=0)])
        return np.asarray(total[last] - total[first])

    known_a, known_b = (
        np.asarray(np.isfinite(v).all(axis=1, keepdims=True), dtype=np.float64) for v in (a, b)
    )
    for i, lag in enumerate(lags.tolist()):
        known = known_a * (shifted(known_b, lag) == 1.0)
        x, y = np.where(known, a, 0.0), np.where(known, shifted(b, lag), 0.0)
        sums = [within(v) for v in (known, x, y, x * x, y * y, x * y)]
        count, (sx, sy, xx, yy, xy) = np.maximum(sums[0], 1.0), sums[1:]
        product = (xy - sx * sy / count).sum(axis=1)
        size = np.sqrt(
            np.maximum((xx - sx**2 / count).sum(axis=1) * (yy - sy**2 / count).sum(axis=1), 0.0)
        )
        enough = (sums[0][:, 0] >= MINIMUM) & (size > 0)
        out[enough, i] = product[enough] / size[enough]
    return out


def correlation(a: FloatArray, b: FloatArray) -> float:
    """Correlation of all columns together, (N, k) each, means removed per column; 0 where too
    little is known."""
    return float(np.trace(products(a, b, np.zeros(1, dtype=np.int64))[0]))


def best_lag(a: FloatArray, b: FloatArray, lags: npt.NDArray[np.int64]) -> tuple[float, float]:
    """(lag in samples, correlation) at which b, moved later by the lag, is most like a; the lag
    between samples too."""
    return peak(np.trace(products(a, b, lags), axis1=1, axis2=2), lags)


def peak(scores: FloatArray, lags: npt.NDArray[np.int64]) -> tuple[float, float]:
    """(lag, also between the ones tried, score there) of the highest of the scores (L,)."""
    i = int(np.argmax(scores))
    lag, top = float(lags[i]), float(scores[i])
    if 0 < i < len(lags) - 1:
        left, right = scores[i - 1], scores[i + 1]
        bend = left - 2 * top + right
        if bend < 0:
            lag += 0.5 * float((left - right) / bend)
    return lag, top
