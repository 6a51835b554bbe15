"""Angular momentum of the spinning rotors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from greybox.plants.effects.base import Hub, PlantEffect
from greybox.plants.vectors import Number, Vector


@dataclass(frozen=True, kw_only=True)
class RotorGyroscopic(PlantEffect):
    """tau = -omega x (J_r sum s_i Omega_i e_z) - J_r sum s_i dOmega_i/dt e_z; J_r [kg m^2].

    The second term is zero for rotors without lag, which change speed in no time. Rigid-body
    mechanics.
    """

    name: ClassVar[str] = "rotor_gyroscopic"
    needs_speed_rate: ClassVar[bool] = True
    J_r: Number = 0.0

    def hub_moment(self, hub: Hub) -> Vector:
        """What turning and accelerating one rotor costs the body [N m]."""
        p, q, _ = hub.body.rates
        momentum = self.J_r * hub.spin * hub.speed
        return (-q * momentum, p * momentum, -self.J_r * hub.spin * hub.body.speed_rate[hub.index])
