"""Rational quadratic, k = (1 + r^2/(2 alpha))^-alpha: squared exponentials of many
length-scales."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from greybox.errors import ModelError
from greybox.residual.covariances.covariance import Covariance, Pick, Stationary
from greybox.symbolic import FloatArray, Namespace, Numeric

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True, kw_only=True, eq=False)
class RationalQuadratic(Stationary):
    """A mixture of length-scales; `alpha` > 0, large: the squared exponential."""

    kind = "rational_quadratic"
    module = "RQKernel"
    lengthscales: FloatArray
    alpha: float

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.alpha > 0:
            raise ModelError("rational quadratic: alpha must be positive", got=f"{self.alpha:g}")

    def of(self, square: Numeric, xp: Namespace) -> tuple[Numeric, Numeric]:
        """c and its slope in r^2."""
        base = 1.0 + square / (2.0 * self.alpha)
        c = xp.exp(-self.alpha * xp.log(base))
        return c, -0.5 * c / base

    @classmethod
    def read(cls, module: torch.nn.Module, pick: Pick) -> Covariance:
        """From the GPyTorch module of this kind."""
        return cls(lengthscales=pick(module.lengthscale, 2), alpha=pick.scalar(module.alpha, 1))
