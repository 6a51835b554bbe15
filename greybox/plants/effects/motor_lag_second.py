"""A lag of second order: a filter before the motor, or a motor that overshoots."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from greybox.plants.effects.base import PlantEffect
from greybox.plants.vectors import Number


@dataclass(frozen=True, kw_only=True)
class MotorLagSecond(PlantEffect):
    """b tau^2 nu'' + tau nu' + nu = nu_ss, tau the time constant of motor_lag."""

    name: ClassVar[str] = "motor_lag_second"
    b: Number = 0.0

    def lag_second(self) -> Number:
        """The coefficient b [-]."""
        return self.b
