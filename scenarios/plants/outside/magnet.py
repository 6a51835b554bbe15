"""Torque of a magnet on board in the field of the earth: it depends on the heading."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from greybox.plants.effects.base import Body, PlantEffect
from greybox.plants.vectors import Number, Vector, apply_transposed, cross


@dataclass(frozen=True, kw_only=True)
class Magnet(PlantEffect):
    """tau = m e_x x R^T b, b = (0, 1, 0) north; m = moment times field [N m]."""

    name: ClassVar[str] = "magnet"
    m: Number = 0.0

    def body_moment(self, body: Body) -> Vector:
        """Moment [N m], body axes."""
        north = apply_transposed(body.rotation, (0.0, 1.0, 0.0))
        return cross((self.m, 0.0, 0.0), north)
