"""Thrust that falls when a rotor climbs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from greybox.plants.effects.base import Hub, PlantEffect
from greybox.plants.vectors import Number


@dataclass(frozen=True, kw_only=True)
class AxialInflow(PlantEffect):
    """dT_i = -k_z Omega_i v_a,i,z; k_z [kg/rad]. Momentum theory of a hovering rotor, linear in the
    axial airspeed."""

    name: ClassVar[str] = "axial_inflow"
    k_z: Number = 0.0

    def thrust_increment(self, hub: Hub) -> Number:
        """Thrust lost in a climb [N]."""
        return -self.k_z * hub.speed * hub.airspeed[2]
