"""Motion-capture markers that are not square to the body."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from greybox.plants.effects.base import PlantEffect
from greybox.plants.vectors import Number, Quaternion, multiply, quaternion_of


@dataclass(frozen=True, kw_only=True)
class MocapMisalignment(PlantEffect):
    """v_marker = Exp(theta)^T v_body, so that the measured attitude is q * exp(theta/2); theta
    [rad]."""

    name: ClassVar[str] = "mocap_misalignment"
    order: ClassVar[int] = 1
    theta_x: Number = 0.0
    theta_y: Number = 0.0
    theta_z: Number = 0.0

    def attitude(self, q: Quaternion) -> Quaternion:
        """Attitude of the marker frame."""
        return multiply(q, quaternion_of((self.theta_x, self.theta_y, self.theta_z)))
