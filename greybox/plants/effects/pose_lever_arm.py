"""A tracked point that is not the body origin."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from greybox.plants.effects.base import PlantEffect
from greybox.plants.vectors import Number, Vector


@dataclass(frozen=True, kw_only=True)
class PoseLeverArm(PlantEffect):
    """Position and velocity are those of the point r from the body origin; r [m], body."""

    name: ClassVar[str] = "pose_lever_arm"
    r_x: Number = 0.0
    r_y: Number = 0.0
    r_z: Number = 0.0

    def pose_shift(self) -> Vector:
        """The shift, body [m]."""
        return (self.r_x, self.r_y, self.r_z)
