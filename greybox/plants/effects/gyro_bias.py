"""Constant offset of the gyro."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from greybox.plants.effects.base import PlantEffect
from greybox.plants.vectors import Number, Vector, add


@dataclass(frozen=True, kw_only=True)
class GyroBias(PlantEffect):
    """omega_meas = omega + b; b [rad/s]."""

    name: ClassVar[str] = "gyro_bias"
    order: ClassVar[int] = 3
    b_x: Number = 0.0
    b_y: Number = 0.0
    b_z: Number = 0.0

    def gyro(self, rates: Vector) -> Vector:
        """Reading with bias [rad/s]."""
        return add(rates, (self.b_x, self.b_y, self.b_z))
