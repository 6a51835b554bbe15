"""A wall on one side: recirculating air pulls the vehicle towards it and rolls it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from greybox.plants.effects.base import Body, PlantEffect
from greybox.plants.vectors import Number, Vector, apply_transposed, cross


@dataclass(frozen=True, kw_only=True)
class Wall(PlantEffect):
    """Force of `pull` [N] at 1 m from a wall at x = `place` [m], falling with the square of the
    distance (never nearer than 0.3 m), towards the wall; it acts `arm` [m] above the centre of
    mass."""

    name: ClassVar[str] = "wall"
    pull: Number = 0.0
    place: Number = 2.5
    arm: Number = 0.0

    def body_force(self, body: Body) -> Vector:
        """Pull towards the wall, body axes [N]."""
        gap = self.place - body.position[0]
        # A smooth floor of 0.3 m under the distance, for one vehicle and for batches alike.
        near = gap * gap + 0.09
        return apply_transposed(body.rotation, (self.pull / near, 0.0, 0.0))

    def body_moment(self, body: Body) -> Vector:
        """Its moment [N m]."""
        return cross((0.0, 0.0, self.arm), self.body_force(body))
