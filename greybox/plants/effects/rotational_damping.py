"""Moment against the body rates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from greybox.plants.effects.base import Body, PlantEffect
from greybox.plants.vectors import Number, Vector


@dataclass(frozen=True, kw_only=True)
class RotationalDamping(PlantEffect):
    """tau = -diag(d_p, d_q, d_r) omega; d [N m s]."""

    name: ClassVar[str] = "rotational_damping"
    d_p: Number = 0.0
    d_q: Number = 0.0
    d_r: Number = 0.0

    def body_moment(self, body: Body) -> Vector:
        """Damping moment [N m]."""
        p, q, r = body.rates
        return (-self.d_p * p, -self.d_q * q, -self.d_r * r)
