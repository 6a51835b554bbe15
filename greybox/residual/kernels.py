"""Covariance functions of the residual GP, each formula written once for NumPy arrays and for
CasADi expressions.

Samples are columns here, (n_in, N), so that one expression serves a NumPy batch and a single
symbolic column. All inputs are in standardised units. Rasmussen and Williams, Gaussian Processes
for Machine Learning (2006), chapter 4.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
import numpy.typing as npt

from greybox.errors import FileFormatError, ModelError, UnknownNameError
from greybox.files import Json, Parsed
from greybox.symbolic import Expr, FloatArray, Namespace, Numeric

FAMILIES = ("se", "matern32", "matern52")
"""Stationary parts; "linear+<family>" adds a linear part."""
FADE_POWER = 8
"""The linear part is faded out as 1/(1 + sum_d (x_d/reach_d)^8)."""


def split_name(name: str) -> tuple[str, bool]:
    """("se", True) of "linear+se". Raises `UnknownNameError` for a kernel that is not there."""
    linear, family = name.startswith("linear+"), name.removeprefix("linear+")
    if family not in FAMILIES:
        raise UnknownNameError("kernel", name, [*FAMILIES, *(f"linear+{f}" for f in FAMILIES)])
    return family, linear


def _frozen(values: npt.ArrayLike) -> FloatArray:
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


@dataclass(frozen=True, kw_only=True, eq=False)
class Kernel:
    """Stationary kernel with one length-scale per input (ARD), plus a faded linear part if `slopes`
    is given.

    k(x, b) = variance c(r), r^2 = sum_d ((x_d - b_d)/lengthscales_d)^2, c by `family`: exp(-r^2/2)
    for se, (1 + a) exp(-a) with a = sqrt(3) r for matern32, (1 + a + a^2/3) exp(-a) with a =
    sqrt(5) r for matern52. The linear part is sum_d slopes_d phi_d(x) phi_d(b) with phi(x) = x/(1 +
    sum_d (x_d/reach_d)^8): x itself inside the training domain and zero far outside, so that the
    posterior mean returns to the prior mean and the variance stays bounded there. It is a kernel
    like any other (a linear kernel of features), and so the posterior stays consistent.

    `variance` and `slopes` (n_in,) are in standardised output units squared; `lengthscales` and
    `reach` (n_in,) in standardised input units.
    """

    family: str
    lengthscales: FloatArray
    variance: float
    slopes: FloatArray | None = None
    reach: FloatArray | None = None

    def __post_init__(self) -> None:
        split_name(self.family)
        object.__setattr__(self, "lengthscales", _frozen(self.lengthscales))
        object.__setattr__(self, "variance", float(self.variance))
        if (self.slopes is None) != (self.reach is None):
            raise ModelError("a linear part needs both slopes and reach")
        if self.slopes is not None and self.reach is not None:
            object.__setattr__(self, "slopes", _frozen(self.slopes))
            object.__setattr__(self, "reach", _frozen(self.reach))
            if not self.slopes.shape == self.reach.shape == self.lengthscales.shape:
                raise ModelError("slopes, reach and lengthscales of different length")
            if not (self.slopes >= 0).all() or not (self.reach > 0).all():
                raise ModelError("slopes must not be negative and reach must be positive")
        if not (self.lengthscales > 0).all() or not self.variance >= 0:
            raise ModelError("length-scales must be positive and the variance not negative")

    @property
    def name(self) -> str:
        """The kernel's name as `split_name` takes it."""
        return self.family if self.slopes is None else f"linear+{self.family}"

    def covariance(self, support: FloatArray, x: Numeric, xp: Namespace = np) -> Numeric:
        """k(support, x): (M, N) for support (n_in, M) and x (n_in, N); a column for a CasADi column
        with xp=casadi."""
        k, _ = self.covariance_and_slope(support, x, xp)
        return k

    def covariance_and_slope(
        self, support: FloatArray, x: Numeric, xp: Namespace = np
    ) -> tuple[Numeric, Numeric]:
        """(k, g): k(support, x) (M, N), and g = d(stationary part)/d(r^2) (M, N), which the
        Jacobian needs."""
        w = self.lengthscales**-2
        # |x - b|^2 expanded: one matrix product instead of M differences.
        square = (w[None, :] @ (x * x)) + (w @ support**2)[:, None] - 2.0 * ((support.T * w) @ x)
        c, g = correlation(self.family, square, xp)
        k, g = self.variance * c, self.variance * g
        if self.slopes is not None:
            k = k + (self.features(support).T * self.slopes) @ self.features(x)
        return k, g

    def paired(self, x: FloatArray, b: FloatArray) -> FloatArray:
        """k(x_i, b_i) (N,) of columns x and b (n_in, N)."""
        square = (((x - b) / self.lengthscales[:, None]) ** 2).sum(axis=0)
        k: FloatArray = self.variance * correlation(self.family, square, np)[0]
        if self.slopes is not None:
            k = k + self.slopes @ (self.features(x) * self.features(b))
        return k

    def prior_variance(self, x: Numeric, xp: Namespace = np) -> Numeric:
        """k(x, x): (1, N)."""
        if self.slopes is None:
            return np.full((1, x.shape[1]), self.variance) if xp is np else self.variance
        features = self.features(x)
        return self.variance + self.slopes[None, :] @ (features * features)

    def features(self, x: Numeric) -> Numeric:
        """phi(x) of the linear part: (n_in, N)."""
        assert self.reach is not None
        return x / (1.0 + (self.reach ** -float(FADE_POWER))[None, :] @ x**FADE_POWER)

    def contract(self, support: FloatArray, x: Expr, g: Expr, c: Expr) -> Expr:
        """sum_i c_i dk(b_i, x)/dx as a row (1, n_in), for a column c (M, 1) and g of
        `covariance_and_slope`."""
        cg = c * g
        row = 2.0 * (self.lengthscales**-2)[None, :] * (x.T * ca.sum1(cg) - (ca.DM(support) @ cg).T)
        if self.slopes is not None:
            row += self._through_features(
                (ca.DM(self.slopes[:, None] * self.features(support)) @ c).T, x
            )
        return row

    def prior_variance_slope(self, x: Expr) -> Expr:
        """dk(x, x)/dx as a row (1, n_in)."""
        if self.slopes is None:
            return ca.DM.zeros(1, len(self.lengthscales))
        return 2.0 * self._through_features((ca.DM(self.slopes) * self.features(x)).T, x)

    def _through_features(self, row: Expr, x: Expr) -> Expr:
        """row (1, n_in) times dphi/dx."""
        assert self.reach is not None
        scale = self.reach ** -float(FADE_POWER)
        fade = 1.0 / (1.0 + scale[None, :] @ x**FADE_POWER)
        return (
            fade * row - (row @ x) * fade**2 * (FADE_POWER * ca.DM(scale) * x ** (FADE_POWER - 1)).T
        )

    def to_dict(self) -> dict[str, Json]:
        """Plain JSON values."""
        return {
            "family": self.family,
            "lengthscales": self.lengthscales.tolist(),
            "variance": self.variance,
            "slopes": None if self.slopes is None else self.slopes.tolist(),
            "reach": None if self.reach is None else self.reach.tolist(),
        }

    @classmethod
    def from_dict(cls, value: Parsed) -> Kernel:
        """Inverse of `to_dict`. Raises `FileFormatError`."""
        try:
            return cls(**value)
        except (TypeError, ValueError) as error:
            raise FileFormatError(f"not a kernel: {error}") from None


def correlation(family: str, square: Numeric, xp: Namespace) -> tuple[Numeric, Numeric]:
    """(c(r), dc/d(r^2)) for square = r^2, elementwise; `xp` is numpy, torch or casadi. Smooth
    through r = 0."""
    if family == "se":
        c = xp.exp(-0.5 * square)
        return c, -0.5 * c
    # The expanded square can be a rounding error below zero, and sqrt has no slope at zero.
    positive = xp.fmax(square, 1e-30 + 0.0 * square)
    if family == "matern32":
        a = xp.sqrt(3.0 * positive)
        e = xp.exp(-a)
        return (1.0 + a) * e, -1.5 * e
    a = xp.sqrt(5.0 * positive)
    e = xp.exp(-a)
    return (1.0 + a + a * a / 3.0) * e, -(5.0 / 6.0) * (1.0 + a) * e
