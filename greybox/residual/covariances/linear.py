"""Linear, k = sum_d variances_d x_d b_d."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from greybox.errors import ModelError
from greybox.residual.covariances.covariance import Covariance, Pick, Pullback, frozen
from greybox.symbolic import Expr, FloatArray, Namespace, Numeric

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True, kw_only=True, eq=False)
class Linear(Covariance):
    """Straight lines through zero; `variances` of their slopes, one per input or one for all."""

    kind = "linear"
    module = "LinearKernel"
    variances: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "variances", frozen(self.variances).reshape(-1))
        if not (self.variances >= 0).all():
            raise ModelError("linear: variances must not be negative")

    def column(self, support: FloatArray, x: Numeric, xp: Namespace) -> tuple[Numeric, Pullback]:
        """k and its pullback."""
        weighted = support * np.broadcast_to(self.variances, support.shape[1:])
        k = weighted @ x if xp is np else ca.DM(weighted) @ x

        def back(c: Expr) -> Expr:
            return (ca.DM(weighted.T) @ c).T

        return k, back

    def variance(self, x: Numeric, xp: Namespace) -> Numeric:
        """k(x, x)."""
        row = np.broadcast_to(self.variances, (x.shape[0],))[None, :]
        return row @ (x * x) if xp is np else ca.DM(np.array(row)) @ (x * x)

    def variance_slope(self, x: Expr) -> Expr:
        """dk(x, x)/dx."""
        return 2.0 * (ca.DM(np.array(np.broadcast_to(self.variances, (x.shape[0],)))) * x).T

    @classmethod
    def read(cls, module: torch.nn.Module, pick: Pick) -> Covariance:
        """From the GPyTorch module of this kind."""
        return cls(variances=pick(module.variance, 2))
