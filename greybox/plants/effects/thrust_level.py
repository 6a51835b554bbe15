"""Rotors that are all stronger or weaker than the data sheet says."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from greybox.plants.effects.base import Hub, PlantEffect
from greybox.plants.vectors import Number


@dataclass(frozen=True, kw_only=True)
class ThrustLevel(PlantEffect):
    """T_i and Q_i scaled by 1 + s."""

    name: ClassVar[str] = "thrust_level"
    s: Number = 0.0

    def thrust_factor(self, hub: Hub) -> Number:
        """1 + s."""
        return 1.0 + self.s

    def torque_factor(self, hub: Hub) -> Number:
        """1 + s."""
        return 1.0 + self.s
