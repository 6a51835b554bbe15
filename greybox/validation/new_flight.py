"""How much wider regions have to be for a flight that was not seen, from how the flights that were
seen differ.

Errors of one flight have a scale of their own: one is rougher than another, and the model of each
is off by something else. Levels that fit all flights together cover too little on a new one, whose
scale is not among them. In the spirit of a hierarchical model the logarithms of the flights' scales
are a sample from a normal distribution; the scale of a new flight, mean and spread unknown, is then
Student-distributed with n - 1 degrees of freedom and sqrt(1 + 1/n) times the spread of the sample
(Gelman et al., Bayesian Data Analysis, 3rd ed. 2013, sections 3.2 and 5.4). Errors need not be
Gaussian: scale and coverage are read off the share that each flight's own errors leave inside.
"""

from __future__ import annotations

import numpy as np

from greybox.statistics.distributions import student_quantile
from greybox.symbolic import FloatArray

GRID = np.log(4.0) * np.linspace(-1.0, 1.0, 57)
"""Logarithms of the factors at which shares are counted."""
FEWEST = 3
"""Below this number of flights nothing can be said about how they differ."""
NODES = 99


def new_flight_factor(inside: FloatArray, level: float = 0.95) -> float:
    """Factor of at least 1 on the standard deviations, so that regions hold the share `level` of a
    new flight's errors.

    inside (n, 57): the share of each seen flight's errors inside its regions with all deviations
    multiplied by exp(GRID). The share expected of a new flight is the mean over its unknown scale;
    the factor is at most 4. One for fewer than `FEWEST` flights.
    """
    n = len(inside)
    if n < FEWEST:
        return 1.0
    # The own factor of every flight, and how shares grow around it, on average.
    own = np.array([float(np.interp(level, np.maximum.accumulate(row), GRID)) for row in inside])
    around = np.mean(
        [np.interp(GRID + at, GRID, row) for at, row in zip(own, inside, strict=True)], axis=0
    )
    nodes = student_quantile((np.arange(NODES) + 0.5) / NODES, n - 1)
    scale = own.mean() + own.std(ddof=1) * np.sqrt(1.0 + 1.0 / n) * nodes
    expected = np.array([np.interp(at - scale, GRID, around).mean() for at in GRID])
    enough = np.flatnonzero(expected >= level)
    if not enough.size:
        return float(np.exp(GRID[-1]))
    return max(
        1.0, float(np.exp(np.interp(level, expected[: enough[0] + 1], GRID[: enough[0] + 1])))
    )
