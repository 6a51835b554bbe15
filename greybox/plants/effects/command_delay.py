"""Pure delay between the logged command and the motor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from greybox.plants.effects.base import PlantEffect


@dataclass(frozen=True, kw_only=True)
class CommandDelay(PlantEffect):
    """u_eff(t) = u(t - d), d [s] >= 0; the switch inside a sample is placed exactly."""

    name: ClassVar[str] = "command_delay"
    d: float = 0.0

    def delay(self) -> float:
        """The delay [s]."""
        return self.d
