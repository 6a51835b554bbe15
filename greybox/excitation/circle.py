"""A horizontal circle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from greybox.excitation.plane_curve import PlaneCurve
from greybox.excitation.signal import Array


@dataclass(frozen=True, kw_only=True)
class Circle(PlaneCurve):
    """Circle, started at its rightmost point."""

    def place(self, angle: Array) -> tuple[Array, Array]:
        """As `PlaneCurve` says."""
        return self.radius * np.cos(angle), self.radius * np.sin(angle)
