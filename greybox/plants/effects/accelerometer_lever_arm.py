"""An accelerometer that sits elsewhere than the airframe says."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from greybox.plants.effects.base import PlantEffect
from greybox.plants.vectors import Number, Vector


@dataclass(frozen=True, kw_only=True)
class AccelerometerLeverArm(PlantEffect):
    """a_meas = a + domega/dt x r + omega x (omega x r); r [m] is added to the airframe's IMU
    position."""

    name: ClassVar[str] = "accelerometer_lever_arm"
    r_x: Number = 0.0
    r_y: Number = 0.0
    r_z: Number = 0.0

    def imu_shift(self) -> Vector:
        """The shift, body [m]."""
        return (self.r_x, self.r_y, self.r_z)
