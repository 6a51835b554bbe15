"""Prior: what is believed of the unknowns before the flights, as a cost.

A number that was measured has a normal prior. The size of an effect that may be there is known by
its order only. Its prior is Cauchy's, weakly informative: beyond what is typical it no longer pulls
(Gelman, Jakulin, Pittau and Su 2008, Annals of Applied Statistics 2(4)). Flights show ratios of
forces to mass. A normal prior about an effect that is ten times the typical size would shrink the
weighed mass with it.
"""

from __future__ import annotations

import math
import numbers
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from greybox.errors import ModelError
from greybox.estimation.unknown import Unknown
from greybox.statistics.normal_mass import log_mass
from greybox.symbolic import FloatArray


class Prior(NamedTuple):
    """`mean` and `sigma` in the unit of the parameter (sigma infinite: no prior); with `long_tails`
    Cauchy's, of which sigma is the scale."""

    mean: float
    sigma: float
    long_tails: bool = False


def demand_priors(option: str, given: object) -> None:
    """Raises `ModelError` where `given` is no mapping of names to (mean, sigma), the mean finite,
    sigma positive (infinite: no prior)."""
    if not isinstance(given, Mapping):
        fix = f"{option}={{'motor_lag.tau': (0.03, 0.01)}}"
        raise ModelError(f"{option} takes names with (mean, sigma)", got=repr(given), fix=fix)
    for name, prior in given.items():
        where = f"{option} of {name}"
        parts = tuple(prior) if isinstance(prior, Sequence | np.ndarray) else ()
        real = [p for p in parts[:2] if isinstance(p, numbers.Real) and not isinstance(p, bool)]
        plain = [float(p) for p in real]
        if isinstance(prior, str) or len(plain) < 2 or len(parts) > 3:
            raise ModelError(
                f"{where}: not a mean with a sigma",
                expected="(mean, sigma) in the unit of the parameter",
                got=repr(prior),
                fix=f"{option}={{'{name}': (mean, sigma)}}; values={{'{name}': ...}} starts there",
            )
        if not math.isfinite(plain[0]):
            raise ModelError(f"{where}: the mean is not finite", got=f"{plain[0]:g}")
        if not plain[1] > 0:
            raise ModelError(
                f"{where}: sigma must be positive (infinite: no prior)",
                got=f"{plain[1]:g}",
                fix=f"fixed=['{name}'], values={{'{name}': {plain[0]:g}}} holds it",
            )


def prior_terms(
    unknowns: Sequence[Unknown], theta: FloatArray
) -> tuple[float, FloatArray, FloatArray]:
    """(cost, gradient (n,), curvature (n,)) of the priors at `theta` (n,), the cost 0 at the means.

    The curvature is the normal prior's; that of Cauchy's is the one of the normal prior with the
    same gradient, which is never negative.
    """
    sigma = np.array([u.sigma for u in unknowns])
    told = np.isfinite(sigma)
    off = np.where(told, theta - np.array([u.mean for u in unknowns]), 0.0)
    precision = np.where(told, sigma, np.inf) ** -2.0
    squared = precision * off * off
    long = np.array([u.long_tails for u in unknowns], dtype=bool)
    curvature = np.where(long, 2.0 / (1.0 + squared), 1.0) * precision
    cost = np.where(long, np.log1p(squared), 0.5 * squared)
    return float(cost.sum()), curvature * off, curvature


def spread_at(u: Unknown, theta: float) -> float:
    """Standard deviation of a normal prior about the mean that believes as much in `theta`."""
    if not u.long_tails:
        return u.sigma
    return math.sqrt(math.pi / 2) * u.sigma * (1 + ((theta - u.mean) / u.sigma) ** 2)


def log_peak(u: Unknown) -> float:
    """Log density of a prior at its mean, with the mass that bounds leave it inside them."""
    peak = -math.log(u.sigma) - (math.log(math.pi) if u.long_tails else 0.5 * math.log(2 * math.pi))
    bounded = np.isfinite(u.lower) or np.isfinite(u.upper)
    if not (bounded and u.kind == "parameter"):
        return peak
    if not u.long_tails:
        return peak - log_mass(u.lower, u.upper, u.mean, u.sigma)
    low, high = (math.atan((b - u.mean) / u.sigma) for b in (u.lower, u.upper))
    return peak - math.log((high - low) / math.pi)
