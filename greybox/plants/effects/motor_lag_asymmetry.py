"""Another time constant for rotors that slow down."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from greybox.plants.effects.base import PlantEffect
from greybox.plants.vectors import Number


@dataclass(frozen=True, kw_only=True)
class MotorLagAsymmetry(PlantEffect):
    """tau_up = tau (1 - a) while a rotor's speed rises, tau_down = tau (1 + a) while it falls; tau
    is that of motor_lag."""

    name: ClassVar[str] = "motor_lag_asymmetry"
    a: Number = 0.0

    def lag_asymmetry(self) -> Number:
        """By which share of itself the lag is longer for a rotor that slows down, and shorter for
        one that speeds up."""
        return self.a
