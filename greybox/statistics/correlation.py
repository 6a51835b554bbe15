"""Sample correlations at given lags of records with gaps: what the whiteness and the input tests
are made of.

Missing samples (NaN) drop out of the pairs that they are in, and every lag carries its own number
of pairs (E. Parzen, "On spectral analysis with missing observations and amplitude modulation",
Sankhya A 25, 1963). Pairs never reach from one record into the next.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from greybox.errors import DataError
from greybox.symbolic import FloatArray


def centred(
    records: Sequence[FloatArray], *, each: bool
) -> tuple[list[FloatArray], list[FloatArray]]:
    """(values, weights): columns minus their mean, 0 where missing; weights 1 where present and 0
    where missing.

    `each=True` takes the mean out of every record, else one mean of all records is used.
    """
    weights = [np.isfinite(r).astype(np.float64) for r in records]
    filled = [np.where(w > 0, r, 0.0) for r, w in zip(records, weights, strict=True)]
    sums, counts = [f.sum(axis=0) for f in filled], [w.sum(axis=0) for w in weights]
    if not each:
        sums, counts = [sum(sums)] * len(records), [sum(counts)] * len(records)
    means = [s / np.maximum(c, 1.0) for s, c in zip(sums, counts, strict=True)]
    return [(f - m) * w for f, m, w in zip(filled, means, weights, strict=True)], weights


def lagged(
    values: Sequence[FloatArray],
    weights: Sequence[FloatArray],
    other: Sequence[FloatArray],
    seen: Sequence[FloatArray],
    lags: Sequence[int],
) -> tuple[FloatArray, FloatArray]:
    """(covariance, pairs), each (lags, d, m): mean of values[t + lag, i] other[t, j] over the pairs
    that are there.

    Where there is no pair the covariance is 0 and the count 0.
    """
    d, m = values[0].shape[1], other[0].shape[1]
    total, count = np.zeros((len(lags), d, m)), np.zeros((len(lags), d, m))
    for a, wa, b, wb in zip(values, weights, other, seen, strict=True):
        n = len(a)
        for i, lag in enumerate(lags):
            if abs(lag) >= n:
                continue
            late, early = (
                (slice(lag, n), slice(0, n - lag))
                if lag >= 0
                else (slice(0, n + lag), slice(-lag, n))
            )
            total[i] += a[late].T @ b[early]
            count[i] += wa[late].T @ wb[early]
    return total / np.maximum(count, 1.0), count


def check_lags(records: Sequence[FloatArray], max_lag: int, *, what: str) -> None:
    """Raise `DataError` unless max_lag >= 1, every column moves, and at least 4 max_lag samples are
    there."""
    if max_lag < 1:
        raise DataError(f"{what}: max_lag must be at least 1", got=str(max_lag))
    counts = sum(np.isfinite(r).sum(axis=0) for r in records)
    if np.min(counts) < 4 * max_lag:
        raise DataError(
            f"{what}: {int(np.min(counts))} samples are too few for {max_lag} lags",
            fix="fewer lags or a longer flight",
        )
    for j in range(records[0].shape[1]):
        column = np.concatenate([r[:, j] for r in records])
        column = column[np.isfinite(column)]
        if np.ptp(column) == 0.0:
            raise DataError(
                f"{what}: column {j + 1} is constant",
                fix="leave it out, a frozen channel tells nothing",
            )


def predictable_share(r: FloatArray) -> float:
    """Share of a signal's variance that an autoregression on its own past explains, in [0, 1].

    `r`: autocorrelation at lags 1..m. Levinson-Durbin: 1 - product of (1 - partial correlation^2).
    An effect size: with many samples a whiteness test rejects dependence that is of no practical
    interest. White noise gives about m / n.
    """
    left, phi = 1.0, np.zeros(0)
    for k in range(len(r)):
        partial = float((r[k] - phi @ r[:k][::-1]) / left)
        # With gaps the estimated sequence need not be positive definite: stop before the recursion
        # leaves [-1, 1].
        if not abs(partial) < 1.0:
            break
        phi = np.append(phi - partial * phi[::-1], partial)
        left *= 1.0 - partial * partial
    return 1.0 - left
