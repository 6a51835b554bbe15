"""First-order lag of the rotor speed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from greybox.plants.effects.base import PlantEffect
from greybox.plants.vectors import Number


@dataclass(frozen=True, kw_only=True)
class MotorLag(PlantEffect):
    """dnu/dt = (nu_ss - nu) / tau, solved exactly between command changes; tau [s]. Standard motor
    model."""

    name: ClassVar[str] = "motor_lag"
    tau: Number = 0.0

    def lag(self) -> Number:
        """The time constant [s]."""
        return self.tau
