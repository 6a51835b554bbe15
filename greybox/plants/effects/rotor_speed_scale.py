"""Scale error of measured rotor speeds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from greybox.plants.effects.base import PlantEffect
from greybox.plants.vectors import Number


@dataclass(frozen=True, kw_only=True)
class RotorSpeedScale(PlantEffect):
    """The telemetry of rotor i shows 1 + s[i] of its speed; s [-], one per rotor."""

    name: ClassVar[str] = "rotor_speed_scale"
    s: tuple[Number, ...] = (0.0, 0.0, 0.0, 0.0)

    def parameters(self) -> dict[str, Number]:
        """`rotor_speed_scale.s_1` to `s_n`."""
        return {f"rotor_speed_scale.s_{i}": share for i, share in enumerate(self.s, 1)}

    def rotor_speed(self, speeds: list[Number]) -> list[Number]:
        """Scaled reading [rad/s]."""
        return [speed + share * speed for share, speed in zip(self.s, speeds, strict=True)]
