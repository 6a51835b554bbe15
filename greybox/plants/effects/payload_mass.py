"""A load at the centre of mass."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from greybox.plants.effects.base import PlantEffect
from greybox.plants.vectors import Number


@dataclass(frozen=True, kw_only=True)
class PayloadMass(PlantEffect):
    """Mass m (1 + mu); mu [-]. Inertia and centre of mass stay as they are."""

    name: ClassVar[str] = "payload_mass"
    mu: Number = 0.0

    def mass_factor(self) -> Number:
        """1 + mu."""
        return 1.0 + self.mu
