"""Constant, k = value: an offset that nobody knows."""

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
class Constant(Covariance):
    """The same covariance everywhere."""

    kind = "constant"
    module = "ConstantKernel"
    value: float

    def __post_init__(self) -> None:
        if not self.value >= 0:
            raise ModelError("constant covariance: must not be negative", got=f"{self.value:g}")

    def column(self, support: FloatArray, x: Numeric, xp: Namespace) -> tuple[Numeric, Pullback]:
        """k and its pullback."""
        width = x.shape[1]
        k = np.full((len(support), width), self.value)

        def back(c: Expr) -> Expr:
            return ca.DM.zeros(1, x.shape[0])

        return (k if xp is np else ca.DM(k)), back

    def variance(self, x: Numeric, xp: Namespace) -> Numeric:
        """k(x, x)."""
        return np.full((1, x.shape[1]), self.value) if xp is np else ca.DM(self.value)

    @classmethod
    def read(cls, module: torch.nn.Module, pick: Pick) -> Covariance:
        """From the GPyTorch module of this kind."""
        return cls(value=pick.scalar(module.constant, 1))
