"""A band of rotor speeds in which a resonating propeller loses thrust."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from greybox.plants.effects.base import Hub, PlantEffect
from greybox.plants.vectors import Number


@dataclass(frozen=True, kw_only=True)
class ThrustGap(PlantEffect):
    """T_i loses the share `depth` at nu = `centre`, less to both sides: 1 - depth exp(-((nu -
    centre) / width)^2)."""

    name: ClassVar[str] = "thrust_gap"
    depth: Number = 0.0
    centre: Number = 0.55
    width: Number = 0.04

    def thrust_factor(self, hub: Hub) -> Number:
        """Factor on the thrust."""
        return 1.0 - self.depth * np.exp(-(((hub.nu - self.centre) / self.width) ** 2))
