"""Betting: an e-process for the mean of bounded numbers (Waudby-Smith and Ramdas 2024, JRSS B
86(1)); the mean of e-values, and what each of several e-values needs."""

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


def bar_of_several(logs: Sequence[float], alone: float) -> float:
    """Log e-value that each of some needs, where one `alone` needs `alone` = log(n / alpha) among n
    hypotheses: less by the log of how many have it (e-BH: Wang and Ramdas 2022, JRSS B 84(3)).

    Of what is said so at most alpha is false on average, whatever depends on what. Where all n are
    null that is the chance of saying anything.
    """
    ranked = sorted(logs, reverse=True)
    bars = [alone - float(np.log(k)) for k in range(1, len(ranked) + 1)]
    return min([alone, *(b for e, b in zip(ranked, bars, strict=True) if e >= b)])
