"""Covariance that survives model error: scores of the log det criterion, summed with Newey and
West's weights.

H^-1 M H^-1 with H = J'J of whitened innovations and M = sum_k (1 - |k| / L) sum_t s_t s_{t-k}' over
the per-sample scores s_t = J_t' Lambda^-1 e_t (White 1982, Econometrica 50(1); Newey and West 1987,
Econometrica 55(3)). It holds where the innovations are coloured or their size changes, as long as
they do not depend on the past that the predictor uses; an output error model (K = 0) under any
disturbance is the case where it is exact for large N. Where a too small K leaves innovations that
depend on past outputs, H lacks their product with the second derivatives of the prediction: it is
then better than the Fisher covariance, not exact.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from greybox.linear.pem import Settings, Solution
from greybox.linear.predictor import sensitivities
from greybox.linear.records import Record
from greybox.symbolic import FloatArray

LARGEST = 40_000_000
"""Most numbers that the sensitivities of one record may hold (320 MB)."""
FEWEST = 20
"""Fewest windows that the samples must fill for their scatter to say anything; a longer window is
cut to that."""


def score_covariance(
    solution: Solution, records: Sequence[Record], settings: Settings, window: int
) -> FloatArray | None:
    """M (d, d) along the tangent of the solution, initial states and offsets projected off;
    Bartlett window of that length.

    None where there are too few samples for any window, or a record is too long for its
    sensitivities to be held.
    """
    n, m, p = solution.system.sizes
    width = n * (n + m + p) + p * (n + m)
    samples = sum(len(r) for r in records)
    window = min(window, samples // FEWEST)
    if window < 4 or max(len(r) for r in records) * p * width > LARGEST:
        return None
    keep = np.concatenate([np.full(n, settings.free_start), np.full(p, settings.offsets)])
    total = np.zeros((solution.tangent.shape[1],) * 2)
    for record, prediction in zip(records, solution.evaluation.predictions):
        j, jx, jc = sensitivities(solution.system, record, prediction, solution.evaluation.modes)
        white = prediction.whitener
        if white is None:
            white = np.linalg.inv(np.linalg.cholesky(solution.evaluation.noise))[None]
        e = np.squeeze(white @ prediction.e[:, :, None], axis=2)
        slopes = white @ (j @ solution.tangent)
        own = (white @ np.concatenate([jx, jc], axis=2)[:, :, keep]).reshape(e.size, -1)
        flat = slopes.reshape(e.size, -1)
        if own.size:
            flat = flat - own @ (
                np.linalg.pinv(own.T @ own, rcond=1e-11, hermitian=True) @ (own.T @ flat)
            )
        scores = (flat * e.reshape(-1, 1)).reshape(len(e), p, -1).sum(axis=1)
        # Sums over every window of the length, also those that overhang the ends: their scatter has
        # Bartlett's weights.
        sums = np.cumsum(np.vstack([np.zeros((1, scores.shape[1])), scores]), axis=0)
        edge = np.arange(1 - window, len(e))
        windows = sums[np.minimum(edge + window, len(e))] - sums[np.maximum(edge, 0)]
        total += windows.T @ windows / window
    return total


def correlation_window(innovations: Sequence[FloatArray]) -> int:
    """Twice the lag after which every channel's autocorrelation stays within +-2.6 / sqrt(N) for 3
    lags, at least 4.

    `innovations`: records (N_i, p), NaN = missing. Lags up to an eighth of the longest record, at
    most 500, are looked at.
    """
    longest = max(len(e) for e in innovations)
    last = 1
    for channel in range(innovations[0].shape[1]):
        columns = [np.nan_to_num(e[:, channel] - np.nanmean(e[:, channel])) for e in innovations]
        power = sum(float(c @ c) for c in columns)
        band = 2.6 / np.sqrt(sum(len(c) for c in columns))
        quiet = 0
        for lag in range(1, min(longest // 8, 500)):
            r = sum(float(c[lag:] @ c[:-lag]) for c in columns if len(c) > lag) / power
            quiet = 0 if abs(r) > band else quiet + 1
            if quiet == 0:
                last = max(last, lag)
            if quiet >= 3:
                break
    return max(2 * last, 4)
