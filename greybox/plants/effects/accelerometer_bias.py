"""Constant offset of the accelerometer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from greybox.plants.effects.base import PlantEffect
from greybox.plants.vectors import Number, Vector, add


@dataclass(frozen=True, kw_only=True)
class AccelerometerBias(PlantEffect):
    """a_meas = a + b; b [m/s^2]."""

    name: ClassVar[str] = "accelerometer_bias"
    order: ClassVar[int] = 3
    b_x: Number = 0.0
    b_y: Number = 0.0
    b_z: Number = 0.0

    def accelerometer(self, specific_force: Vector) -> Vector:
        """Reading with bias [m/s^2]."""
        return add(specific_force, (self.b_x, self.b_y, self.b_z))
