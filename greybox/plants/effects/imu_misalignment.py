"""An IMU that is not mounted square to the body."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from greybox.plants.effects.base import PlantEffect
from greybox.plants.vectors import Number, Vector, apply_transposed, quaternion_of, rotation


@dataclass(frozen=True, kw_only=True)
class ImuMisalignment(PlantEffect):
    """v_imu = Exp(theta)^T v_body for gyro and accelerometer; theta [rad]."""

    name: ClassVar[str] = "imu_misalignment"
    order: ClassVar[int] = 1
    theta_x: Number = 0.0
    theta_y: Number = 0.0
    theta_z: Number = 0.0

    def _turn(self, v: Vector) -> Vector:
        return apply_transposed(
            rotation(quaternion_of((self.theta_x, self.theta_y, self.theta_z))), v
        )

    def gyro(self, rates: Vector) -> Vector:
        """Rates in IMU axes [rad/s]."""
        return self._turn(rates)

    def accelerometer(self, specific_force: Vector) -> Vector:
        """Specific force in IMU axes [m/s^2]."""
        return self._turn(specific_force)
