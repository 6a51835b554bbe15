"""Noise inflation: what time correlation of the errors costs in information, and noise levels by
group.

The closed-form posteriors take the noise of neighbouring samples for independent. Errors of a
flight are correlated in time, so that N samples hold only N/tau of them, tau = 1 + 2 sum_k rho_k,
the integrated autocorrelation time (Bartlett 1946; Geyer, Practical Markov chain Monte Carlo, 1992,
for where to stop the sum). The noise variance times tau in the posterior gives a mean of a smooth
function the variance that it really has. The noise of a single new sample stays as it is.
"""

from __future__ import annotations

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft

from greybox.symbolic import FloatArray, IntArray


def autocorrelation_time(e: FloatArray, place: IntArray, group: IntArray) -> float:
    """Integrated autocorrelation time of e (N,), at least 1, pooled over groups.

    `place` (N,) is the row of each sample in the record before rows were dropped (gaps count as
    gaps), `group` (N,) the number of its flight. The sum is cut where the sum of two neighbouring
    lags first is not positive, and at a third of the longest group: a constant error inside flights
    counts as correlation, so the mean is not taken out.
    """
    products: dict[int, FloatArray] = {}
    counts: dict[int, FloatArray] = {}
    longest = 0
    for g in np.unique(group):
        rows = np.flatnonzero(group == g)
        at = place[rows] - place[rows].min()
        n = int(at.max()) + 1
        values, there = np.zeros(n), np.zeros(n)
        values[at], there[at] = e[rows], 1.0
        size = next_fast_len(2 * n)
        products[int(g)] = irfft(np.abs(rfft(values, size)) ** 2, size)[:n]
        counts[int(g)] = irfft(np.abs(rfft(there, size)) ** 2, size)[:n]
        longest = max(longest, n)
    lags = max(longest // 3, 1)
    product, count = np.zeros(lags), np.zeros(lags)
    for g, p in products.items():
        m = min(lags, p.size)
        product[:m] += p[:m]
        count[:m] += np.round(counts[g][:m])
    if product[0] <= 0:
        return 1.0
    rho = np.where(count > 0, product, 0.0) / product[0]
    pairs = rho[1 : 1 + 2 * ((lags - 1) // 2)].reshape(-1, 2).sum(axis=1)
    ends = np.flatnonzero(pairs <= 0)
    return max(1.0, 1.0 + 2.0 * float(pairs[: ends[0] if ends.size else pairs.size].sum()))


def group_variances(e: FloatArray, group: IntArray) -> dict[int, float]:
    """Mean square of e (N,) in each group."""
    return {int(g): float(np.mean(e[group == g] ** 2)) for g in np.unique(group)}


def groups_differ(e: FloatArray, group: IntArray, tau: float) -> bool:
    """Whether a noise level per group beats one for all, by the BIC at the effective sample size
    N/tau."""
    levels = group_variances(e, group)
    if len(levels) < 2 or min(levels.values()) <= 0:
        return False
    sizes = {g: float(np.sum(group == g)) / tau for g in levels}
    total = sum(sizes.values())
    pooled = sum(sizes[g] * levels[g] for g in levels) / total
    gain = total * np.log(pooled) - sum(sizes[g] * np.log(levels[g]) for g in levels)
    return bool(gain > (len(levels) - 1) * np.log(total))
