"""Covariances of covariances: sum, product, scale, and some of the inputs only."""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from operator import mul

import casadi as ca
import numpy as np

from greybox.errors import ModelError
from greybox.files import Json, Parsed
from greybox.residual.covariances.covariance import Covariance, Pullback, covariance_from_dict
from greybox.symbolic import Expr, FloatArray, Namespace, Numeric


@dataclass(frozen=True, kw_only=True, eq=False)
class Sum(Covariance):
    """k = sum of `parts`."""

    kind = "sum"
    module = "AdditiveKernel"
    parts: tuple[Covariance, ...]

    def column(self, support: FloatArray, x: Numeric, xp: Namespace) -> tuple[Numeric, Pullback]:
        """k and its pullback."""
        both = [part.column(support, x, xp) for part in self.parts]

        def back(c: Expr) -> Expr:
            return sum((pull(c) for _, pull in both[1:]), both[0][1](c))

        return sum((k for k, _ in both[1:]), both[0][0]), back

    def variance(self, x: Numeric, xp: Namespace) -> Numeric:
        """k(x, x)."""
        return sum(part.variance(x, xp) for part in self.parts)

    def variance_slope(self, x: Expr) -> Expr:
        """dk(x, x)/dx."""
        return sum(part.variance_slope(x) for part in self.parts)

    def to_dict(self) -> dict[str, Json]:
        """Plain JSON values."""
        return {"kind": self.kind, "parts": [part.to_dict() for part in self.parts]}

    @classmethod
    def from_dict(cls, value: Parsed) -> Covariance:
        """Inverse of `to_dict`."""
        return cls(parts=tuple(covariance_from_dict(part) for part in value["parts"]))


@dataclass(frozen=True, kw_only=True, eq=False)
class Product(Covariance):
    """k = product of `parts`."""

    kind = "product"
    module = "ProductKernel"
    parts: tuple[Covariance, ...]

    def column(self, support: FloatArray, x: Numeric, xp: Namespace) -> tuple[Numeric, Pullback]:
        """k and its pullback."""
        both = [part.column(support, x, xp) for part in self.parts]
        values = [k for k, _ in both]

        def back(c: Expr) -> Expr:
            rows = []
            for i, (_, pull) in enumerate(both):
                rows.append(pull(reduce(mul, values[:i] + values[i + 1 :], c)))
            return sum(rows[1:], rows[0])

        return reduce(mul, values), back

    def variance(self, x: Numeric, xp: Namespace) -> Numeric:
        """k(x, x)."""
        return reduce(mul, (part.variance(x, xp) for part in self.parts))

    def variance_slope(self, x: Expr) -> Expr:
        """dk(x, x)/dx."""
        values = [part.variance(x, ca) for part in self.parts]
        rows = [
            reduce(mul, values[:i] + values[i + 1 :], part.variance_slope(x))
            for i, part in enumerate(self.parts)
        ]
        return sum(rows[1:], rows[0])

    to_dict = Sum.to_dict

    @classmethod
    def from_dict(cls, value: Parsed) -> Covariance:
        """Inverse of `to_dict`."""
        return cls(parts=tuple(covariance_from_dict(part) for part in value["parts"]))


@dataclass(frozen=True, kw_only=True, eq=False)
class Scaled(Covariance):
    """k = `factor` times that of `inner`."""

    kind = "scaled"
    module = "ScaleKernel"
    factor: float
    inner: Covariance

    def __post_init__(self) -> None:
        if not self.factor >= 0:
            raise ModelError(
                "a covariance cannot be scaled by a negative factor", got=f"{self.factor:g}"
            )

    def column(self, support: FloatArray, x: Numeric, xp: Namespace) -> tuple[Numeric, Pullback]:
        """k and its pullback."""
        k, pull = self.inner.column(support, x, xp)
        return self.factor * k, lambda c: self.factor * pull(c)

    def variance(self, x: Numeric, xp: Namespace) -> Numeric:
        """k(x, x)."""
        return self.factor * self.inner.variance(x, xp)

    def variance_slope(self, x: Expr) -> Expr:
        """dk(x, x)/dx."""
        return self.factor * self.inner.variance_slope(x)

    def to_dict(self) -> dict[str, Json]:
        """Plain JSON values."""
        return {"kind": self.kind, "factor": self.factor, "inner": self.inner.to_dict()}

    @classmethod
    def from_dict(cls, value: Parsed) -> Covariance:
        """Inverse of `to_dict`."""
        return cls(factor=value["factor"], inner=covariance_from_dict(value["inner"]))


@dataclass(frozen=True, kw_only=True, eq=False)
class OnDims(Covariance):
    """k of `inner` on the inputs `dims` alone (GPyTorch's active_dims)."""

    kind = "on_dims"
    dims: tuple[int, ...]
    inner: Covariance

    def __post_init__(self) -> None:
        object.__setattr__(self, "dims", tuple(int(d) for d in self.dims))

    def column(self, support: FloatArray, x: Numeric, xp: Namespace) -> tuple[Numeric, Pullback]:
        """k and its pullback."""
        k, pull = self.inner.column(support[:, list(self.dims)], x[list(self.dims), :], xp)
        back_in = self._places(x.shape[0])
        return k, lambda c: pull(c) @ back_in

    def _places(self, n: int) -> Expr:
        matrix = np.zeros((len(self.dims), n))
        matrix[range(len(self.dims)), self.dims] = 1.0
        return ca.sparsify(ca.DM(matrix))

    def variance(self, x: Numeric, xp: Namespace) -> Numeric:
        """k(x, x)."""
        return self.inner.variance(x[list(self.dims), :], xp)

    def variance_slope(self, x: Expr) -> Expr:
        """dk(x, x)/dx."""
        return self.inner.variance_slope(x[list(self.dims), :]) @ self._places(x.shape[0])

    def to_dict(self) -> dict[str, Json]:
        """Plain JSON values."""
        return {"kind": self.kind, "dims": list(self.dims), "inner": self.inner.to_dict()}

    @classmethod
    def from_dict(cls, value: Parsed) -> Covariance:
        """Inverse of `to_dict`."""
        return cls(dims=tuple(value["dims"]), inner=covariance_from_dict(value["inner"]))
