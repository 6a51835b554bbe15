"""Constant offset of the gyro."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from scenarios.plants.effects.base import PlantEffect
from scenarios.plants.vectors import Number, Vector, add


@dataclass(frozen=True, kw_only=True)
class GyroBias(PlantEffect):
    """omega_meas = omega + b; b [rad/s]."""

    name: ClassVar[str] = "gyro_bias"
    order: ClassVar[int] = 3
    b_p: Number = 0.0
    b_q: Number = 0.0
    b_r: Number = 0.0

    def gyro(self, rates: Vector) -> Vector:
        """Reading with bias [rad/s]."""
        return add(rates, (self.b_p, self.b_q, self.b_r))
