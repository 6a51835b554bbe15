"""The tail of the chi-square distribution where its probability is smaller than the smallest
number."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy.special

from greybox.statistics.distributions import chi_square_tail
from greybox.symbolic import FloatArray

FAR = -600.0
"""Logarithm below which the series is taken; numbers end near -745."""


def log_tail(statistic: npt.ArrayLike, dof: int) -> FloatArray:
    """ln P(chi-square > statistic), finite for every finite statistic (n,); the probability itself is
    zero from 1500 on for one degree.

    ln Q(a, z) = (a - 1) ln z - z - ln Gamma(a) + ln sum_k (a - 1) ... (a - k) / z^k with a = dof /
    2 and z = statistic / 2 (Abramowitz and Stegun 1964, 6.5.32).
    """
    x = np.atleast_1d(np.asarray(statistic, dtype=np.float64))
    with np.errstate(divide="ignore"):
        out = np.log(chi_square_tail(x, dof))
    far = (out < FAR) & np.isfinite(x)
    a, z = 0.5 * dof, 0.5 * x[far]
    term, total = np.ones_like(z), np.ones_like(z)
    for k in range(1, int(a) + 6):  # the terms fall: that far out z is well above a
        term = term * (a - k) / z
        total += term
    out[far] = (a - 1) * np.log(z) - z - scipy.special.gammaln(a) + np.log(total)
    return out
