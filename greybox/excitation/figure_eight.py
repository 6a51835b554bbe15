"""A figure of eight made of two sines."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from greybox.excitation.plane_curve import PlaneCurve
from greybox.excitation.signal import Array


@dataclass(frozen=True, kw_only=True)
class FigureEight(PlaneCurve):
    """Lissajous figure, half as high as wide, started at its centre."""

    def place(self, angle: Array) -> tuple[Array, Array]:
        """As `PlaneCurve` says."""
        return self.radius * np.sin(angle), 0.5 * self.radius * np.sin(2.0 * angle)
