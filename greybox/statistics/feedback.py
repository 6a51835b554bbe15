"""Whether a signal follows what is new in others: feedback, found without a model of the loop.

First what the past of both does not foretell of the others, their innovations; then whether past
innovations foretell more of the signal than its own past does. In an open loop they do not,
whatever the signal is (C. W. J. Granger, Econometrica 37(3), 1969; L. D. Haugh, J. Am. Stat. Assoc.
71, 1976, on using innovations).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from greybox.statistics.distributions import fisher_tail
from greybox.symbolic import FloatArray

LAGS = 20
"""Samples of the past."""
MOST_ROWS = 20_000
"""Samples that are looked at, at most."""
LEAST_SHARE = 0.02
"""Share of the unforetold part that the others must explain: less does no harm to an estimate."""
NOTHING_NEW = 1e-6
"""Share of a signal that its own past must leave open; what follows the rest is rounding."""


def follows(stretches: Sequence[FloatArray], signal: int, others: Sequence[int]) -> bool | None:
    """Whether column `signal` of the `stretches` (N_i, c) follows the past of the columns `others`;
    None where there is nothing to tell it from (too few samples, a signal without news)."""
    kept, left = [], MOST_ROWS
    for s in stretches:
        part = s[:left]
        if len(part) > 4 * LAGS:
            kept.append(part[:, [signal, *others]])
            left -= len(part)
    both = 1 + len(others)
    if sum(len(s) - 2 * LAGS for s in kept) < 3 * LAGS * both:
        return None
    size = np.maximum(np.concatenate(kept).std(axis=0), 1e-300)
    kept = [(s - s.mean(axis=0)) / size for s in kept]
    past = [np.hstack([s[LAGS:, :1], _past(s)]) for s in kept]
    x, y = np.concatenate(past), np.concatenate([s[LAGS:, 1:] for s in kept])
    known = np.linalg.lstsq(x.T @ x, x.T @ y, rcond=1e-12)[0]
    news = [
        np.column_stack([s[LAGS:, 0], s[LAGS:, 1:] - p @ known])
        for s, p in zip(kept, past, strict=True)
    ]
    rows = np.concatenate(
        [np.hstack([s[LAGS:, :1], _past(s[:, :1]), _past(s[:, 1:])]) for s in news]
    )
    n, wide = rows.shape
    gram = rows.T @ rows
    alone, full = _left(gram[: 1 + LAGS, : 1 + LAGS]), _left(gram)
    if alone < NOTHING_NEW * gram[0, 0]:
        return None
    extra, dof = wide - 1 - LAGS, n - wide
    f = (alone - full) / extra / (full / dof)
    return bool(fisher_tail(f, extra, dof) < 1e-4 and (alone - full) / alone > LEAST_SHARE)


def _past(s: FloatArray) -> FloatArray:
    """The `LAGS` samples before each row from `LAGS` on, (N - LAGS, LAGS c)."""
    return np.hstack([s[LAGS - k : len(s) - k] for k in range(1, LAGS + 1)])


def _left(gram: FloatArray) -> float:
    """Sum of squares of the first column that a regression on the others leaves; where they foretell
    all of it, what rounding leaves (never less, so it has a sign)."""
    solution = np.linalg.lstsq(gram[1:, 1:], gram[1:, 0], rcond=1e-12)[0]
    rounding = np.finfo(np.float64).eps * gram[0, 0]
    return float(max(gram[0, 0] - gram[0, 1:] @ solution, rounding))
