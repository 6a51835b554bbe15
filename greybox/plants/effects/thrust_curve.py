"""Command shaped between linear and quadratic."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from greybox.plants.effects.base import PlantEffect
from greybox.plants.vectors import Number


@dataclass(frozen=True, kw_only=True)
class ThrustCurve(PlantEffect):
    """u_eff = (1 - f) u + f u^2; the form of the thrust-model factor of the PX4 mixer."""

    name: ClassVar[str] = "thrust_curve"
    order: ClassVar[int] = 2
    f: Number = 0.0

    def command(self, u: Number) -> Number:
        """Shaped command."""
        return u + self.f * u * (u - 1.0)
