"""Principal axes that are not the body axes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from greybox.plants.effects.base import PlantEffect
from greybox.plants.vectors import ZERO, Number, Vector


@dataclass(frozen=True, kw_only=True)
class ProductsOfInertia(PlantEffect):
    """Off-diagonal elements J[0,1], J[0,2], J[1,2] of the inertia matrix [kg m^2], added to the
    airframe's."""

    name: ClassVar[str] = "products_of_inertia"
    Jxy: Number = 0.0
    Jxz: Number = 0.0
    Jyz: Number = 0.0

    def inertia_change(self) -> tuple[Vector, Vector]:
        """The increments; the moments stay as they are."""
        return (ZERO, (self.Jxy, self.Jxz, self.Jyz))
