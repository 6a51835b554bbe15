"""Telemetry of rotor speeds that is late."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from greybox.plants.effects.base import PlantEffect


@dataclass(frozen=True, kw_only=True)
class RotorSpeedDelay(PlantEffect):
    """Rotor speeds are seen as they were d [s] >= 0 ago, all else as it is."""

    name: ClassVar[str] = "rotor_speed_delay"
    d: float = 0.0

    def rotor_speed_delay(self) -> float:
        """The delay [s]."""
        return self.d
