"""Scale error of the accelerometer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from greybox.plants.effects.base import PlantEffect
from greybox.plants.vectors import Number, Vector


@dataclass(frozen=True, kw_only=True)
class AccelerometerScale(PlantEffect):
    """a_meas = (I + diag(s)) a; s [-]."""

    name: ClassVar[str] = "accelerometer_scale"
    order: ClassVar[int] = 2
    s_x: Number = 0.0
    s_y: Number = 0.0
    s_z: Number = 0.0

    def accelerometer(self, specific_force: Vector) -> Vector:
        """Scaled reading [m/s^2]."""
        x, y, z = specific_force
        return (x + self.s_x * x, y + self.s_y * y, z + self.s_z * z)
