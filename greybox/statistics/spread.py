"""The unit in which a column of numbers is standardised."""

from __future__ import annotations

import numpy as np

from greybox.symbolic import FloatArray

ROUNDING = 1e-12
"""Share of a column's size below which it does not move."""


def spread_of(values: FloatArray) -> FloatArray:
    """Standard deviation (n,) of every column of values (N, n), 1 of one that does not move. The
    extremes tell that: by rounding, the mean of equal numbers is not quite one of them."""
    moves = np.ptp(values, axis=0) > ROUNDING * np.abs(values).max(axis=0)
    return np.where(moves, values.std(axis=0), 1.0)
