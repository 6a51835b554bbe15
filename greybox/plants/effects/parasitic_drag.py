"""Drag of the fuselage, quadratic in airspeed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from greybox.plants.effects.base import Body, PlantEffect
from greybox.plants.vectors import Number, Vector, norm


@dataclass(frozen=True, kw_only=True)
class ParasiticDrag(PlantEffect):
    """F_j = -c_j v_a,j |v_a| with v_a of the centre of mass; c [N s^2/m^2]."""

    name: ClassVar[str] = "parasitic_drag"
    c_x: Number = 0.0
    c_y: Number = 0.0
    c_z: Number = 0.0

    def body_force(self, body: Body) -> Vector:
        """Drag force [N]."""
        x, y, z = body.airspeed
        size = norm(body.airspeed)
        return (-self.c_x * x * size, -self.c_y * y * size, -self.c_z * z * size)
