"""Centre of mass that is not where the vehicle file says."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from greybox.plants.effects.base import PlantEffect
from greybox.plants.vectors import Number, Vector


@dataclass(frozen=True, kw_only=True)
class CenterOfMassOffset(PlantEffect):
    """Shift c of the centre of mass [m]: every rotor and sensor lever arm changes by -c; gravity
    has no moment."""

    name: ClassVar[str] = "center_of_mass_offset"
    c_x: Number = 0.0
    c_y: Number = 0.0
    c_z: Number = 0.0

    def center_of_mass_shift(self) -> Vector:
        """The shift, body [m]."""
        return (self.c_x, self.c_y, self.c_z)
