"""The tail of the chi-square distribution where its probability is smaller than the smallest number."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy.special
import scipy.stats

from greybox.symbolic import FloatArray

FAR = 600.0
"""Statistic above which the asymptotic series is taken: its first term left out is then below 1e-6 for up to 30 degrees."""


def log_tail(statistic: npt.ArrayLike, dof: int) -> FloatArray:
    """ln P(chi-square > statistic), finite for every finite statistic (n,); scipy's logsf is -inf from 1400 on.

    ln Q(a, z) = (a - 1) ln z - z - ln Gamma(a) + ln sum_k (a - 1) ... (a - k) / z^k, a = dof / 2, z = statistic / 2
    (Abramowitz and Stegun 1964, 6.5.32).
    """
    x = np.atleast_1d(np.asarray(statistic, dtype=np.float64))
    out = np.asarray(scipy.stats.chi2.logsf(x, dof), dtype=np.float64)
    far = x > FAR
    a, z = 0.5 * dof, 0.5 * x[far]
    term, total = np.ones_like(z), np.ones_like(z)
    for k in range(1, 6):
        term = term * (a - k) / z
        total += term
    out[far] = (a - 1) * np.log(z) - z - scipy.special.gammaln(a) + np.log(total)
    return out
