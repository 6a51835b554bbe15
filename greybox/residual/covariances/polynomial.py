"""Polynomial, k = (x.b + offset)^power."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from greybox.errors import ModelError
from greybox.residual.covariances.covariance import Covariance, Pick, Pullback
from greybox.symbolic import Expr, FloatArray, Namespace, Numeric

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True, kw_only=True, eq=False)
class Polynomial(Covariance):
    """All polynomials up to degree `power`."""

    kind = "polynomial"
    module = "PolynomialKernel"
    power: int
    offset: float

    def __post_init__(self) -> None:
        if self.power < 1 or self.power != int(self.power) or not self.offset >= 0:
            raise ModelError("polynomial: a whole power of at least 1 and an offset of at least 0")

    def column(self, support: FloatArray, x: Numeric, xp: Namespace) -> tuple[Numeric, Pullback]:
        """k and its pullback."""
        base = (support @ x if xp is np else ca.DM(support) @ x) + self.offset

        def back(c: Expr) -> Expr:
            return self.power * (ca.DM(support.T) @ (c * base ** (self.power - 1))).T

        return base**self.power, back

    def variance(self, x: Numeric, xp: Namespace) -> Numeric:
        """k(x, x)."""
        square = np.sum(x * x, axis=0, keepdims=True) if xp is np else ca.sumsqr(x)
        return (square + self.offset) ** self.power

    def variance_slope(self, x: Expr) -> Expr:
        """dk(x, x)/dx."""
        return 2.0 * self.power * (ca.sumsqr(x) + self.offset) ** (self.power - 1) * x.T

    @classmethod
    def read(cls, module: torch.nn.Module, pick: Pick) -> Covariance:
        """From the GPyTorch module of this kind."""
        return cls(power=int(module.power), offset=pick.scalar(module.offset, 1))
