"""A cable to the ground: its weight grows with the height, and it pulls back to where it is
fixed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from greybox.plants.effects.base import Body, PlantEffect
from greybox.plants.vectors import Number, Vector, apply_transposed


@dataclass(frozen=True, kw_only=True)
class Tether(PlantEffect):
    """World force (-stiffness x, -stiffness y, -weight z): stiffness [N/m], weight per length
    [N/m], fixed at the origin."""

    name: ClassVar[str] = "tether"
    stiffness: Number = 0.0
    weight: Number = 0.0

    def body_force(self, body: Body) -> Vector:
        """Pull of the cable, body axes [N]."""
        x, y, z = body.position
        return apply_transposed(
            body.rotation, (-self.stiffness * x, -self.stiffness * y, -self.weight * z)
        )
