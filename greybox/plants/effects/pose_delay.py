"""Motion capture that is late."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from greybox.plants.effects.base import PlantEffect


@dataclass(frozen=True, kw_only=True)
class PoseDelay(PlantEffect):
    """Attitude, position and velocity are seen as they were d [s] >= 0 ago, IMU and commands as
    they are."""

    name: ClassVar[str] = "pose_delay"
    d: float = 0.0

    def pose_delay(self) -> float:
        """The delay [s]."""
        return self.d
