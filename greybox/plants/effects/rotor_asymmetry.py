"""Rotors that are stronger or weaker than their neighbours."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from greybox.plants.effects.base import Hub, PlantEffect
from greybox.plants.vectors import Number


@dataclass(frozen=True, kw_only=True)
class RotorAsymmetry(PlantEffect):
    """T_i and Q_i scaled by 1 + delta_i, sum(delta) = 0: the common part belongs to the thrust and
    torque maps."""

    name: ClassVar[str] = "rotor_asymmetry"
    delta: tuple[Number, ...] = (0.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        total = sum(self.delta)
        if not np.all(np.abs(total) < 1e-9):
            raise ValueError(
                f"rotor_asymmetry: the deltas must sum to zero, they sum to {total}; "
                "put the common part into the thrust map"
            )

    def parameters(self) -> dict[str, Number]:
        """`rotor_asymmetry.delta_1` to `delta_n`."""
        return {f"rotor_asymmetry.delta_{i}": d for i, d in enumerate(self.delta, 1)}

    def thrust_factor(self, hub: Hub) -> Number:
        """1 + delta_i."""
        return 1.0 + self.delta[hub.index]

    def torque_factor(self, hub: Hub) -> Number:
        """1 + delta_i."""
        return 1.0 + self.delta[hub.index]
