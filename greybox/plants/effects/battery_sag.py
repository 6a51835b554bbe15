"""Rotor speed that follows the battery voltage."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from greybox.plants.effects.base import PlantEffect
from greybox.plants.vectors import Number


@dataclass(frozen=True, kw_only=True)
class BatterySag(PlantEffect):
    """nu_ss scaled by 1 + c_V (V - V0) / V0; V0 is `nominal_voltage` [V]."""

    name: ClassVar[str] = "battery_sag"
    nominal_voltage: float
    c_V: Number = 0.0

    def parameters(self) -> dict[str, Number]:
        """`battery_sag.c_V`; the nominal voltage belongs to the vehicle."""
        return {"battery_sag.c_V": self.c_V}

    def rotor_factor(self, voltage: Number) -> Number:
        """The factor at this voltage."""
        return 1.0 + self.c_V * (voltage - self.nominal_voltage) / self.nominal_voltage
