"""Betting: an e-process for the mean of bounded numbers (Waudby-Smith and Ramdas 2024, JRSS B
86(1))."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

BETS = tuple(k / 10 for k in range(1, 10))
"""Shares of the capital that are bet, mixed evenly."""


def betting(changes: npt.NDArray[np.float64]) -> float:
    """Log e-value that the mean of `changes`, bounded by one, is above zero at some time."""
    if not changes.size:
        return 0.0
    capital = np.array([np.log1p(b * changes).sum() for b in BETS])
    return float(np.logaddexp.reduce(capital) - np.log(len(BETS)))
