"""Periodic, k = exp(-2 sum_d sin^2(pi (x_d - b_d)/period_d)/lengthscale_d)."""

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
class Periodic(Covariance):
    """Repeats itself with `periods`, one per input or one for all; `lengthscales` are GPyTorch's,
    which divide the squared sine itself (the square of those of Rasmussen and Williams)."""

    kind = "periodic"
    module = "PeriodicKernel"
    lengthscales: FloatArray
    periods: FloatArray

    def __post_init__(self) -> None:
        for name in ("lengthscales", "periods"):
            value = frozen(getattr(self, name)).reshape(-1)
            object.__setattr__(self, name, value)
            if not (value > 0).all():
                raise ModelError(f"periodic: {name} must be positive")

    def column(self, support: FloatArray, x: Numeric, xp: Namespace) -> tuple[Numeric, Pullback]:
        """k and its pullback."""
        n = support.shape[1]
        rate, size = (
            np.broadcast_to(v, (n,)) for v in (np.pi / self.periods, 1.0 / self.lengthscales)
        )
        angles = [rate[d] * (x[d : d + 1, :] - support[:, d : d + 1]) for d in range(n)]
        k = xp.exp(-2.0 * sum(size[d] * xp.sin(a) ** 2 for d, a in enumerate(angles)))

        def back(c: Expr) -> Expr:
            ck = c * k
            return ca.horzcat(
                *(
                    -2.0 * size[d] * rate[d] * ca.dot(ck, ca.sin(2.0 * a))
                    for d, a in enumerate(angles)
                )
            )

        return k, back

    def variance(self, x: Numeric, xp: Namespace) -> Numeric:
        """k(x, x)."""
        return np.ones((1, x.shape[1])) if xp is np else ca.DM(1.0)

    @classmethod
    def read(cls, module: torch.nn.Module, pick: Pick) -> Covariance:
        """From the GPyTorch module of this kind."""
        return cls(lengthscales=pick(module.lengthscale, 2), periods=pick(module.period_length, 2))
