"""Motors that saturate inside the range of the command."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from greybox.plants.effects.base import PlantEffect
from greybox.plants.vectors import Number, clip


@dataclass(frozen=True, kw_only=True)
class CommandSaturation(PlantEffect):
    """u_eff = clip(u, u_min + a_lo, u_max - a_hi); a_lo, a_hi [-] >= 0, u_min and u_max are the
    vehicle's limits."""

    name: ClassVar[str] = "command_saturation"
    order: ClassVar[int] = 1
    a_lo: Number = 0.0
    a_hi: Number = 0.0
    u_min: float = 0.0
    u_max: float = 1.0

    def parameters(self) -> dict[str, Number]:
        """`command_saturation.a_lo` and `.a_hi`; the limits belong to the vehicle."""
        return {"command_saturation.a_lo": self.a_lo, "command_saturation.a_hi": self.a_hi}

    def command(self, u: Number) -> Number:
        """Limited command."""
        return clip(u, self.u_min + self.a_lo, self.u_max - self.a_hi)
