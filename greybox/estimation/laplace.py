"""Evidence of a fit: the integral of likelihood times prior over its unknowns.

Laplace's approximation at the maximum a posteriori (Kass and Raftery 1995, JASA 90(430), sec. 4.1),
exact for a linear Gaussian model. A size with long tails that the flights do not tell counts half a
unit too little: against a cause. A parameter that ended at its bound is integrated along one side,
and a prior that a bound cuts holds its mass on the side that is allowed.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.special

from greybox.estimation.prior import log_peak
from greybox.estimation.solver import Value
from greybox.estimation.unknown import SearchSpace
from greybox.statistics.normal_mass import log_mass
from greybox.statistics.regret import information_on
from greybox.symbolic import BoolArray, FloatArray

WEAK = 1e-8
"""Precision, per squared scale, of an unknown without prior that nothing tells: a flat prior."""


def at_bound(space: SearchSpace, theta: FloatArray, value: Value) -> BoolArray:
    """Which unknowns (n,) a bound holds back."""
    assert value.gradient is not None
    low, high = theta <= space.lower, theta >= space.upper
    return np.asarray((low & (value.gradient > 0)) | (high & (value.gradient < 0)))


def free_information(
    space: SearchSpace, theta: FloatArray, value: Value, places: Sequence[int]
) -> FloatArray:
    """On the unknowns at `places` (k, k), all others that no bound holds integrated out."""
    assert value.hessian is not None
    free = np.flatnonzero(~at_bound(space, theta, value)).tolist()
    return information_on(value.hessian, places, [i for i in free if i not in places])


def log_evidence(space: SearchSpace, theta: FloatArray, value: Value) -> float:
    """Log of the integral of likelihood times prior about `theta` (n,), see the module."""
    assert value.gradient is not None and value.hessian is not None
    scale = space.scale
    gradient = value.gradient * scale
    h = value.hessian * np.outer(scale, scale) + WEAK * np.eye(space.n)
    held = at_bound(space, theta, value)
    free = ~held
    told = h[np.ix_(free, free)]
    sign, logdet = np.linalg.slogdet(told)
    variance = np.diag(np.linalg.inv(told)) if sign > 0 else np.zeros(0)
    if sign <= 0 or (variance <= 0).any():  # not positive definite, by rounding
        return -np.inf
    total = -value.cost + float(np.log(scale).sum())
    total += 0.5 * float(free.sum()) * np.log(2 * np.pi) - 0.5 * float(logdet)
    for i in np.flatnonzero(held).tolist():  # integral of exp(-g t - h t^2 / 2) over t > 0
        g, c = abs(gradient[i]), h[i, i]
        ratio = scipy.special.erfcx(g / np.sqrt(2 * c))
        total += float(np.log(np.sqrt(np.pi / (2 * c)) * ratio))
    spread = np.zeros(space.n)
    spread[free] = np.sqrt(variance) * scale[free]
    for i, u in enumerate(space.unknowns):
        bounded = np.isfinite(u.lower) or np.isfinite(u.upper)
        if np.isfinite(u.sigma):
            total += log_peak(u)
        if bounded and u.kind == "parameter" and free[i]:
            total += log_mass(u.lower, u.upper, float(theta[i]), float(spread[i]))
    return float(total)
