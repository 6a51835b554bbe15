"""Thrust that grows near the ground."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from greybox.plants.effects.base import Hub, PlantEffect
from greybox.plants.vectors import Number, clip


@dataclass(frozen=True, kw_only=True)
class GroundEffect(PlantEffect):
    """T_i / T_out = 1 / (1 - k (R / 4z)^2), z the height of hub i above the plane z = 0; k [-] >=
    0, R [m].

    k = 1 is one rotor: I. C. Cheeseman and W. E. Bennett, "The effect of the ground on a helicopter
    rotor in forward flight", ARC R&M 3021, 1955. Multirotors gain more: P. Sanchez-Cuevas, G.
    Heredia and A. Ollero, "Characterization of the aerodynamic ground effect and its influence in
    multirotor control", Int. J. Aerospace Eng., 2017, 1823056. Below z = R/2, where the law is not
    valid, the factor keeps the value it has there.
    """

    name: ClassVar[str] = "ground_effect"
    rotor_radius: float
    k: Number = 0.0

    def parameters(self) -> dict[str, Number]:
        """`ground_effect.k`; the radius belongs to the vehicle."""
        return {"ground_effect.k": self.k}

    def thrust_factor(self, hub: Hub) -> Number:
        """The factor at this hub's height."""
        turn, (x, y, z) = hub.body.rotation, hub.arm
        height = hub.body.position[2] + turn[6] * x + turn[7] * y + turn[8] * z
        ratio = self.rotor_radius / (4.0 * clip(height, 0.5 * self.rotor_radius, float("inf")))
        return 1.0 / (1.0 - self.k * ratio * ratio)
