"""Moment of flapping blades, proportional to rotor speed and airspeed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from greybox.plants.effects.base import Hub, PlantEffect
from greybox.plants.vectors import Number, Vector


@dataclass(frozen=True, kw_only=True)
class BladeFlapping(PlantEffect):
    """tau = sum_i k_flap Omega_i (v_a,i x e_z); positive k_flap [kg m/rad] pitches the nose up in
    forward flight."""

    name: ClassVar[str] = "blade_flapping"
    k_flap: Number = 0.0

    def hub_moment(self, hub: Hub) -> Vector:
        """Moment of one rotor [N m]."""
        vx, vy, _ = hub.airspeed
        scale = self.k_flap * hub.speed
        return (scale * vy, -scale * vx, 0.0)
