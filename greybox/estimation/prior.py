"""Prior: what is believed of the unknowns before the flights, as a cost.

A number that was measured has a normal prior. The size of an effect that may be there is known by
its order only. Its prior is Cauchy's, weakly informative: beyond what is typical it no longer pulls
(Gelman, Jakulin, Pittau and Su 2008, Annals of Applied Statistics 2(4)). Flights show ratios of
forces to mass. A normal prior about an effect that is ten times the typical size would shrink the
weighed mass with it.

A number that a data sheet states may be another craft's. Where causes are compared it is normal
within one sigma and has Cauchy's tails beyond, which join there without a kink: what the flights
deny by ten sigma does not call for a cause that would bring it nearer (O'Hagan 1979, On outlier
rejection phenomena in Bayes inference, J. R. Statist. Soc. B 41(3)).
"""

from __future__ import annotations

import math
import numbers
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from greybox.errors import ModelError
from greybox.estimation.unknown import Unknown
from greybox.model.parameter import Parameter
from greybox.statistics.normal_mass import log_mass
from greybox.symbolic import FloatArray

JOINED = 0.5 - math.log(2.0)
"""What Cauchy's cost lacks at one sigma against the normal prior's, whose slope is the same there."""


class Prior(NamedTuple):
    """`mean` and `sigma` in the unit of the parameter (sigma infinite: no prior); with `long_tails`
    Cauchy's, of which sigma is the scale, or beyond one sigma only (`normal_core`)."""

    mean: float
    sigma: float
    long_tails: bool = False
    normal_core: bool = False


def unknown_of(d: Parameter, start: float, prior: Prior, flight: str | None = None) -> Unknown:
    """The parameter `d`, of one `flight` or (None) of all, as an unknown of a search that starts at
    `start`, with what is believed of it (`prior`, its sigma 0: nothing)."""
    own = 0.0 if d.origin is None and d.lower >= 0 else d.origin
    return Unknown(
        name=d.name,
        kind="parameter",
        flight=flight,
        start=start,
        lower=d.lower,
        upper=d.upper,
        mean=prior.mean,
        sigma=prior.sigma if prior.sigma > 0 else math.inf,
        long_tails=prior.long_tails,
        normal_core=prior.normal_core,
        scale=d.scale,
        unit=d.unit,
        origin=math.nan if own is None else own,
    )


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
        if isinstance(prior, str) or len(plain) < 2 or len(parts) > 4:
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
    core = np.array([u.normal_core for u in unknowns], dtype=bool) & (squared <= 1.0)
    long = np.array([u.long_tails for u in unknowns], dtype=bool) & ~core
    curvature = np.where(long, pull_left(squared), 1.0) * precision
    joined = np.where([u.normal_core for u in unknowns], JOINED, 0.0)
    cost = np.where(long, np.log1p(squared) + joined, 0.5 * squared)
    return float(cost.sum()), curvature * off, curvature


def pull_left(squared: FloatArray) -> FloatArray:
    """Pull of Cauchy's tails in units of the normal prior's, `squared` (n,) sigmas from the mean:
    one at one sigma."""
    return 2.0 / (1.0 + squared)


def denied_share(pulls: FloatArray, precision: FloatArray) -> FloatArray:
    """Share (n,) that normal priors of this `precision` (n,), which pull so (n,), lose if only
    their core is normal."""
    squared = np.divide(pulls**2, precision, out=np.zeros_like(precision), where=precision > 0)
    return np.asarray(1.0 - np.minimum(pull_left(squared), 1.0))


def spread_at(u: Unknown, theta: float) -> float:
    """Standard deviation of a normal prior about the mean that believes as much in `theta`."""
    squared = ((theta - u.mean) / u.sigma) ** 2
    if not u.long_tails:
        return u.sigma
    if not u.normal_core:
        return math.sqrt(math.pi / 2) * u.sigma * (1 + squared)
    cost = 0.5 * squared if squared <= 1.0 else math.log1p(squared) + JOINED
    widest = _area(u, -math.inf, math.inf) / math.sqrt(2 * math.pi) * math.exp(cost)
    wide = widest
    for _ in range(4):
        wide = widest * math.exp(-0.5 * squared / wide**2)
    return u.sigma * wide


def log_peak(u: Unknown) -> float:
    """Log density of a prior at its mean, with the mass that bounds leave it inside them."""
    peak = -math.log(u.sigma) - math.log(_area(u, -math.inf, math.inf))
    bounded = np.isfinite(u.lower) or np.isfinite(u.upper)
    if not (bounded and u.kind == "parameter"):
        return peak
    if not u.long_tails:
        return peak - log_mass(u.lower, u.upper, u.mean, u.sigma)
    low, high = ((b - u.mean) / u.sigma for b in (u.lower, u.upper))
    return -math.log(u.sigma) - math.log(_area(u, low, high))


def _area(u: Unknown, low: float, high: float) -> float:
    """Area under exp(-cost) from `low` to `high`, in sigmas from the mean."""
    if not u.long_tails:
        return math.sqrt(math.pi / 2) * (_erf(high) - _erf(low))
    if not u.normal_core:
        return math.atan(high) - math.atan(low)
    cut = [min(max(b, -1.0), 1.0) for b in (low, high)]
    inside = math.sqrt(math.pi / 2) * (_erf(cut[1]) - _erf(cut[0]))
    beyond = sum(max(math.atan(b) - math.atan(1.0), 0.0) for b in (high, -low))
    beyond -= sum(max(math.atan(b) - math.atan(1.0), 0.0) for b in (low, -high))
    return inside + math.exp(-JOINED) * beyond


def _erf(sigmas: float) -> float:
    return math.erf(sigmas / math.sqrt(2))
