"""Thrust that grows with the airspeed in the plane of the disc."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from greybox.plants.effects.base import Hub, PlantEffect
from greybox.plants.vectors import Number


@dataclass(frozen=True, kw_only=True)
class TranslationalLift(PlantEffect):
    """dT_i = k_h (v_a,i,x^2 + v_a,i,y^2); k_h [N s^2/m^2]."""

    name: ClassVar[str] = "translational_lift"
    k_h: Number = 0.0

    def thrust_increment(self, hub: Hub) -> Number:
        """Thrust gained [N]."""
        x, y, _ = hub.airspeed
        return self.k_h * (x * x + y * y)
