"""Matern of order 1/2, 3/2 or 5/2."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from greybox.errors import ModelError
from greybox.residual.covariances.covariance import Covariance, Pick, Stationary
from greybox.symbolic import FloatArray, Namespace, Numeric

if TYPE_CHECKING:
    import torch

TINY = 1e-30
"""Added below the root: a square root has no slope at zero."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Matern(Stationary):
    """With a = sqrt(2 nu) r: exp(-a), (1 + a) exp(-a) or (1 + a + a^2/3) exp(-a)."""

    kind = "matern"
    module = "MaternKernel"
    lengthscales: FloatArray
    nu: float

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.nu not in (0.5, 1.5, 2.5):
            raise ModelError(
                "Matern of another order", expected="nu 0.5, 1.5 or 2.5", got=f"{self.nu:g}"
            )

    def of(self, square: Numeric, xp: Namespace) -> tuple[Numeric, Numeric]:
        """c and its slope in r^2."""
        a = xp.sqrt(2.0 * self.nu * xp.fmax(square, TINY + 0.0 * square))
        e = xp.exp(-a)
        if self.nu == 0.5:
            return e, -0.5 * e / a
        if self.nu == 1.5:
            return (1.0 + a) * e, -1.5 * e
        return (1.0 + a + a * a / 3.0) * e, -(5.0 / 6.0) * (1.0 + a) * e

    @classmethod
    def read(cls, module: torch.nn.Module, pick: Pick) -> Covariance:
        """From the GPyTorch module of this kind."""
        return cls(lengthscales=pick(module.lengthscale, 2), nu=float(module.nu))
