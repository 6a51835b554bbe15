"""A force that is constant in the world."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from greybox.plants.effects.base import Body, PlantEffect
from greybox.plants.vectors import Number, Vector, apply_transposed


@dataclass(frozen=True, kw_only=True)
class ConstantForce(PlantEffect):
    """Force f through the centre of mass, world axes [N]."""

    name: ClassVar[str] = "constant_force"
    f_x: Number = 0.0
    f_y: Number = 0.0
    f_z: Number = 0.0

    def body_force(self, body: Body) -> Vector:
        """The force turned into body axes [N]."""
        return apply_transposed(body.rotation, (self.f_x, self.f_y, self.f_z))
