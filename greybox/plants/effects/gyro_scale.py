"""Scale error of the gyro."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from greybox.plants.effects.base import PlantEffect
from greybox.plants.vectors import Number, Vector


@dataclass(frozen=True, kw_only=True)
class GyroScale(PlantEffect):
    """omega_meas = (I + diag(s)) omega; s [-]."""

    name: ClassVar[str] = "gyro_scale"
    order: ClassVar[int] = 2
    s_x: Number = 0.0
    s_y: Number = 0.0
    s_z: Number = 0.0

    def gyro(self, rates: Vector) -> Vector:
        """Scaled reading [rad/s]."""
        x, y, z = rates
        return (x + self.s_x * x, y + self.s_y * y, z + self.s_z * z)
