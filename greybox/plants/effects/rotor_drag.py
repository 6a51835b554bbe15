"""Drag of the rotor discs, proportional to rotor speed and to the airspeed in the disc plane."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from greybox.plants.effects.base import Hub, PlantEffect
from greybox.plants.vectors import Number, Vector


@dataclass(frozen=True, kw_only=True)
class RotorDrag(PlantEffect):
    """F_i = -Omega_i diag(k_x, k_y, 0) v_a,i at hub i; k [kg/rad].

    Martin and Salaun, "The true role of accelerometer feedback in quadrotor control", ICRA 2010;
    Faessler, Franchi and Scaramuzza, "Differential flatness of quadrotor dynamics subject to rotor
    drag", RA-L 3(2), 2018.
    """

    name: ClassVar[str] = "rotor_drag"
    k_x: Number = 0.0
    k_y: Number = 0.0

    def hub_force(self, hub: Hub) -> Vector:
        """Drag force at the hub [N]."""
        vx, vy, _ = hub.airspeed
        return (-self.k_x * hub.speed * vx, -self.k_y * hub.speed * vy, 0.0)
