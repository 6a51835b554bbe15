"""An IMU that is late."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from greybox.plants.effects.base import PlantEffect


@dataclass(frozen=True, kw_only=True)
class SensorDelay(PlantEffect):
    """Gyro and accelerometer are seen as they were d [s] >= 0 ago, pose and commands as they
    are."""

    name: ClassVar[str] = "sensor_delay"
    d: float = 0.0

    def imu_delay(self) -> float:
        """The delay [s]."""
        return self.d
