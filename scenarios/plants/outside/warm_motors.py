"""Motors that grow warm and weak: thrust follows a hidden temperature."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from greybox.plants.effects.base import Body, Hub, PlantEffect
from greybox.plants.vectors import Number


@dataclass(frozen=True, kw_only=True)
class WarmMotors(PlantEffect):
    """T_i (1 - fade h): the hidden heat h relaxes to sum(nu^4) / (n nu_ref^4) - 1 within `time`
    [s]."""

    name: ClassVar[str] = "warm_motors"
    hidden: ClassVar[int] = 1
    fade: Number = 0.0
    time: Number = 3.0
    reference: Number = 0.55

    def thrust_factor(self, hub: Hub) -> Number:
        """Factor on the thrust."""
        return 1.0 - self.fade * hub.body.hidden[self.name][0]

    def hidden_rate(self, body: Body) -> list[Number]:
        """The heat follows the power."""
        power = sum(n**4 for n in body.nu) / (len(body.nu) * self.reference**4)
        return [(power - 1.0 - body.hidden[self.name][0]) / self.time]
