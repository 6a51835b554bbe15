"""Coordinates in which every point is a craft: what parameters are drawn in.

A body is a positive density, so that its pseudo-inertia, the matrix of its mass, first and second
moments, is positive definite; that is the same as positive mass and an inertia that obeys the
triangle inequality (Wensing, Kim and Slotine 2017, IEEE RA-L 3(1)). Its Cholesky factor with the
logarithm of the diagonal is free of bounds (Rucker and Wensing 2022, IEEE RA-L 7(2)). About the
centre of mass, as inertia is stated here, that is: logarithm of the mass; the centre itself; and of
the second moments S = tr(I)/2 - I = T D T' (T upper triangular with a unit diagonal) the logarithms
of D and the entries of T. Other parameters that cannot be negative are drawn in their logarithm
where that is nearly the same, the rest as they are.

The covariance is carried over so that means and covariances stay, not linearly: of a flat craft,
whose second moment along z is as uncertain as it is large, a linear one is several times too wide;
and thrust and mass, which flights know by their ratio, have to move alike. What a normal
distribution of D has below zero is first cut off, number by number, and all other parameters go
along: thrust over inertia, which flights know far better than either, stays what it was.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.stats import norm

from greybox.model.parameter import Parameter
from greybox.simulators.craft import Craft
from greybox.symbolic import BoolArray, FloatArray

MOMENTS = ("inertia.xx", "inertia.yy", "inertia.zz")
PRODUCTS = tuple(f"products_of_inertia.{n}" for n in ("Jxy", "Jxz", "Jyz"))
PLACES = ((0, 1), (0, 2), (1, 2))
"""Row and column of each of `PRODUCTS`."""
MAPS = ("thrust", "torque")
RELATIVE = 0.5
"""Sigma over value below which a parameter is drawn in its logarithm, if it is a factor."""
FLAT = 1e-9
"""Least second moment, as a share of their sum: a body as flat as this counts as flat."""
_Numbers = npt.NDArray[np.inexact]


@dataclass(frozen=True, kw_only=True, eq=False)
class Coordinates:
    """Of parameters `names` (d,): a normal distribution with `centre` (d,) and `covariance` (d, d),
    of which those in `positive` (d,) are logarithms. `inertia`: where D and T stand in place of
    moments and products; empty, where inertia does not vary as a whole. `fixed` (3,): what the
    inertia has of products beside its parameters."""

    names: tuple[str, ...]
    centre: FloatArray
    covariance: FloatArray
    positive: BoolArray
    inertia: tuple[int, ...]
    fixed: FloatArray
    bounds: FloatArray

    @staticmethod
    def of(
        craft: Craft,
        declared: Mapping[str, Parameter],
        names: Sequence[str],
        mean: FloatArray,
        covariance: FloatArray,
    ) -> Coordinates:
        """Those of parameters with this mean (d,) and covariance (d, d). Inertia gets its own where
        all moments vary, and all products that are not zero."""
        j = craft.inertia
        fixed = [j[i, k] - craft.get(n) for n, (i, k) in zip(PRODUCTS, PLACES, strict=True)]
        products = [n for n in PRODUCTS if n in names]
        whole = len(products) == 3 or not (products or any(j[i, k] for i, k in PLACES))
        of_inertia = (*MOMENTS, *products)
        inertia: tuple[int, ...] = ()
        if whole and all(n in names for n in MOMENTS):
            inertia = tuple(names.index(n) for n in of_inertia)
        sigma = np.sqrt(np.diag(covariance))
        positive = np.array(
            [
                n == "mass" or (m > 0.0 and s < RELATIVE * m and _is_factor(declared[n]))
                for n, m, s in zip(names, mean, sigma, strict=True)
            ],
            dtype=bool,
        )
        positive[[i for i, n in enumerate(names) if n in of_inertia]] = False
        positive[list(inertia[:3])] = True
        empty = Coordinates(
            names=tuple(names),
            centre=mean,
            covariance=covariance,
            positive=positive,
            inertia=inertia,
            fixed=np.array(fixed),
            bounds=np.array([[declared[n].lower, declared[n].upper] for n in names]).reshape(-1, 2),
        )
        return empty._from_parameters()

    def values(self, steps: FloatArray) -> FloatArray:
        """Parameters (m, d) at steps (m, d) away from the centre, inside their bounds."""
        out = self.centre + steps
        out[:, self.positive] = np.exp(out[:, self.positive])
        free = [i for i, n in enumerate(self.names) if n not in (*MOMENTS, *PRODUCTS)]
        out[:, free] = np.clip(out[:, free], *self.bounds[free].T)
        if self.inertia:
            out[:, self.inertia] = _moments(out[:, self.inertia], self.fixed)
        return out

    def _from_parameters(self) -> Coordinates:
        """From mean and covariance of the parameters to those of the coordinates."""
        centre, c = self.centre.copy(), self.covariance.copy()
        plain: _Numbers = centre
        if self.inertia:
            at = list(self.inertia)
            own = centre[at]
            slope = np.eye(len(c))
            slope[np.ix_(at, at)] = _slope(lambda v: _factors(v, self.fixed), own)
            c = slope @ c @ slope.T
            plain = _factors(own, self.fixed)
            centre[at] = plain
            for i in at[:3]:
                centre, c = _above_zero(centre, c, i)
        # of log-normal numbers: cov = mean mean' (exp(cov of the logarithms) - 1)
        size = np.where(self.positive, centre, 1.0)
        c /= np.outer(size, size)
        pairs = [(t, self.inertia[d]) for t, d in zip(self.inertia[3:], (1, 2, 2), strict=False)]
        for t, d in pairs:  # a product of two uncertain numbers is wider than either alone makes it
            narrower = 1.0 / np.sqrt(1.0 + c[d, d])
            c[t] *= narrower
            c[:, t] *= narrower
        both = np.ix_(self.positive, self.positive)
        c[both] = np.log1p(np.maximum(c[both], FLAT - 1.0))
        for t, d in pairs:  # the mean of T D is that of T times that of D, and their covariance
            centre[t] = centre[t] * plain[self.inertia.index(d)] / size[d] - c[t, d]
        centre = np.where(self.positive, np.log(size) - 0.5 * np.diag(c), centre)
        return Coordinates(**{**vars(self), "centre": centre, "covariance": c})


def _above_zero(mean: FloatArray, c: FloatArray, i: int) -> tuple[FloatArray, FloatArray]:
    """Mean (d,) and covariance (d, d) of what a normal distribution has where its number i is
    positive (Tallis 1961, JRSS B 23(1)): the others go along as far as they are correlated with
    it."""
    sigma = math.sqrt(max(c[i, i], 1e-300))
    away = mean[i] / sigma
    above = math.exp(norm.logpdf(away) - norm.logcdf(away))
    moves = c[:, i] / sigma
    left = c - min(above * (above + away), 1.0) * np.outer(moves, moves)
    return mean + above * moves, left


def _is_factor(d: Parameter) -> bool:
    """Whether it cannot be negative, or belongs to a map that scales as a whole."""
    return d.lower >= 0.0 or d.name.split(".")[0] in MAPS


def _factors(values: _Numbers, fixed: FloatArray) -> _Numbers:
    """D, and T where products are given, of moments and products."""
    s = 0.5 * values[:3].sum() - values[:3]
    off = -(values[3:] + fixed) if len(values) > 3 else np.zeros(3)
    least = FLAT * s.sum()
    d3 = _at_least(s[2], least)
    t13, t23 = off[1] / d3, off[2] / d3
    d2 = _at_least(s[1] - t23**2 * d3, least)
    t12 = (off[0] - t13 * t23 * d3) / d2
    d1 = _at_least(s[0] - t12**2 * d2 - t13**2 * d3, least)
    return np.array([d1, d2, d3, t12, t13, t23])[: len(values)]


def _moments(factors: FloatArray, fixed: FloatArray) -> FloatArray:
    """Moments and products (m, 3 or 6) of D and T (m, 3 or 6)."""
    d1, d2, d3 = factors[:, :3].T
    t12, t13, t23 = factors[:, 3:].T if factors.shape[1] > 3 else np.zeros((3, len(factors)))
    x, y = d1 + t12**2 * d2 + t13**2 * d3, d2 + t23**2 * d3
    off = np.stack([t12 * d2 + t13 * t23 * d3, t13 * d3, t23 * d3], axis=1)
    whole = np.hstack([np.stack([y + d3, x + d3, x + y], axis=1), -off - fixed])
    return np.asarray(whole[:, : factors.shape[1]])


def _at_least(value: complex, least: complex) -> complex:
    """`value`, not below `least`, with the slope of `value`."""
    return value if np.real(value) >= np.real(least) else value + np.real(least - value)


def _slope(function: Callable[[_Numbers], _Numbers], at: FloatArray) -> FloatArray:
    """Jacobian of a smooth function (k,) -> (k,), by complex steps."""
    step = 1e-30
    columns = [np.imag(function(at + 1j * step * e)) / step for e in np.eye(len(at))]
    return np.array(columns).T
