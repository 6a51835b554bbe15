"""A wind that does not change."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from greybox.plants.effects.base import Body, PlantEffect
from greybox.plants.vectors import Number, Vector


@dataclass(frozen=True, kw_only=True)
class SteadyWind(PlantEffect):
    """Wind w, world axes [m/s]; it enters every airspeed as v - w and acts only through a drag
    effect."""

    name: ClassVar[str] = "steady_wind"
    w_x: Number = 0.0
    w_y: Number = 0.0
    w_z: Number = 0.0

    def wind(self, body: Body) -> Vector:
        """The wind, world [m/s]."""
        return (self.w_x, self.w_y, self.w_z)
