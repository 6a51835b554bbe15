"""Betting: an e-process for the mean of bounded numbers (Waudby-Smith and Ramdas 2024, JRSS B
86(1)); the mean of e-values is one, too."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

BETS = tuple(k / 10 for k in range(1, 10))
"""Shares of the capital that are bet, mixed evenly."""


def log_mean(logs: Sequence[float] | npt.NDArray[np.float64]) -> float:
    """Log of the mean of numbers that are given by their logarithms."""
    return float(np.logaddexp.reduce(logs) - np.log(len(logs)))


def betting(changes: npt.NDArray[np.float64]) -> float:
    """Log e-value that the mean of `changes`, bounded by one, is above zero at some time."""
    if not changes.size:
        return 0.0
    return log_mean([float(np.log1p(b * changes).sum()) for b in BETS])
