"""First-order lag of the rotor speed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from scenarios.plants.effects.base import PlantEffect
from scenarios.plants.vectors import Number


@dataclass(frozen=True, kw_only=True)
class MotorLag(PlantEffect):
    """dnu/dt = (nu_ss - nu) / tau, solved exactly between command changes; tau [s].

    With tau_down given, tau holds while the speed rises and tau_down while it falls. Standard motor model.
    """

    name: ClassVar[str] = "motor_lag"
    tau: Number = 0.0
    tau_down: Number | None = None

    def parameters(self) -> dict[str, Number]:
        """`motor_lag.tau`, or `motor_lag.tau_up` and `motor_lag.tau_down` when they differ."""
        if self.tau_down is None:
            return {"motor_lag.tau": self.tau}
        return {"motor_lag.tau_up": self.tau, "motor_lag.tau_down": self.tau_down}

    def lag(self) -> tuple[Number, Number]:
        """Time constants up and down [s]."""
        return (self.tau, self.tau if self.tau_down is None else self.tau_down)
