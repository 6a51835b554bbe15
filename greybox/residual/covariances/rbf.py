"""Squared exponential, k = exp(-r^2/2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from greybox.residual.covariances.covariance import Covariance, Pick, Stationary
from greybox.symbolic import FloatArray, Namespace, Numeric

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True, kw_only=True, eq=False)
class RBF(Stationary):
    """Squared exponential with one length-scale per input (ARD) or one for all."""

    kind = "rbf"
    module = "RBFKernel"
    lengthscales: FloatArray

    def of(self, square: Numeric, xp: Namespace) -> tuple[Numeric, Numeric]:
        """c and its slope in r^2."""
        c = xp.exp(-0.5 * square)
        return c, -0.5 * c

    @classmethod
    def read(cls, module: torch.nn.Module, pick: Pick) -> Covariance:
        """From the GPyTorch module of this kind."""
        return cls(lengthscales=pick(module.lengthscale, 2))
