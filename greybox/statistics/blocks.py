"""Blocks of consecutive samples that count as independent where single samples do not."""

from __future__ import annotations

import numpy as np

from greybox.symbolic import FloatArray

BLOCK_SECONDS = 0.5
"""Length [s] of the blocks over which scores are summed: longer than what innovations are
correlated over.

Sums over blocks longer than the correlation scatter as much as the whole does (W. K. Newey and K.
D. West, "A simple, positive semi-definite, heteroskedasticity and autocorrelation consistent
covariance matrix", Econometrica 55(3), 1987).
"""


def block_samples(dt: float, seconds: float = BLOCK_SECONDS) -> int:
    """Samples, at least one, of a block of `seconds` [s] at the sample time `dt` [s]."""
    return max(1, round(seconds / dt))


def clearly(changes: FloatArray) -> bool:
    """Whether the mean of the changes (n,) of every second is above zero by two standard errors."""
    if changes.size < 2:
        return False
    return bool(changes.mean() > 2 * np.std(changes) / np.sqrt(changes.size - 1))
