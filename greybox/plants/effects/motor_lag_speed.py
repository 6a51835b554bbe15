"""A lag that is shorter for rotors that turn faster."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from greybox.plants.effects.base import PlantEffect
from greybox.plants.vectors import Number


@dataclass(frozen=True, kw_only=True)
class MotorLagSpeed(PlantEffect):
    """J dnu/dt = b (nu_ss - nu) + k (nu_ss^2 - nu^2): the motor's own damping and the drag of its
    propeller, which at the speed `hover` [-] is the share s of the rate 1 / tau of motor_lag."""

    name: ClassVar[str] = "motor_lag_speed"
    hover: Number
    s: Number = 0.0

    def parameters(self) -> dict[str, Number]:
        """`motor_lag_speed.s`; the speed that hovers belongs to the vehicle."""
        return {"motor_lag_speed.s": self.s}

    def lag_drag(self) -> tuple[Number, Number]:
        """Shares of 1 / tau: that of the motor, and that of the propeller per unit of 2 nu."""
        return 1.0 - self.s, self.s / (2.0 * self.hover)
