"""Mass of a normal distribution between two bounds."""

from __future__ import annotations

import math

import scipy.special


def log_mass(low: float, high: float, mean: float, sigma: float) -> float:
    """Log of what a normal distribution has between two bounds; at least that of 1e-300."""
    a, b = (low - mean) / sigma, (high - mean) / sigma
    if a > 0:  # the upper tail has the digits of the lower one only when mirrored
        a, b = -b, -a
    return math.log(max(float(scipy.special.ndtr(b) - scipy.special.ndtr(a)), 1e-300))
