"""Drag of the body, proportional to airspeed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from greybox.plants.effects.base import Body, PlantEffect
from greybox.plants.vectors import Number, Vector


@dataclass(frozen=True, kw_only=True)
class LinearDrag(PlantEffect):
    """F_j = -d_j v_a,j with v_a of the centre of mass; d [N s/m]."""

    name: ClassVar[str] = "linear_drag"
    d_x: Number = 0.0
    d_y: Number = 0.0
    d_z: Number = 0.0

    def body_force(self, body: Body) -> Vector:
        """Drag force [N]."""
        x, y, z = body.airspeed
        return (-self.d_x * x, -self.d_y * y, -self.d_z * z)
