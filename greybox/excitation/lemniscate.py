"""The lemniscate of Bernoulli, tighter at the ends than a figure of two sines."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from greybox.excitation.plane_curve import PlaneCurve
from greybox.excitation.signal import Array


@dataclass(frozen=True, kw_only=True)
class Lemniscate(PlaneCurve):
    """Bernoulli's lemniscate, started at its right end."""

    def place(self, angle: Array) -> tuple[Array, Array]:
        """As `PlaneCurve` says."""
        x = self.radius * np.cos(angle) / (1.0 + np.sin(angle) ** 2)
        y = self.radius * np.sin(angle) * np.cos(angle) / (1.0 + np.sin(angle) ** 2)
        return x, y
