"""Drift: a random walk of a sensor's zero, c+ = c + w.

(El-Sheimy, Hou and Niu 2008, IEEE Trans. Instrumentation and Measurement 57(1): what noise inertial
sensors have.)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from greybox.model.dynamics import Dynamics
from greybox.model.noise.part import Place, SensorPart
from greybox.model.parameter import Parameter
from greybox.symbolic import Expr, FloatArray

FRESH = 0.1
"""Spread at the start, as a share of the sensor's white noise: what a sensor is off by from the
start is a bias, an effect with a name."""
WALK = 0.01
"""Start value of the level of its steps per sample, as a share of the sensor's white noise."""


@dataclass(frozen=True, kw_only=True)
class Drift(SensorPart):
    """A random walk on every component of `sensor`, without parameters."""

    kind = "drift"
    quantities = ()

    def parameters(self, core: Dynamics) -> tuple[Parameter, ...]:
        """None."""
        return ()

    def rate(self, c: Expr, values: Mapping[str, Expr], reading: Expr) -> Expr:
        """0."""
        return c * 0

    def step(self, c: Expr, w: Expr, values: Mapping[str, Expr], reading: Expr, dt: Expr) -> Expr:
        """c + w."""
        return c + w

    def driving(self, level: FloatArray, dt: float) -> FloatArray:
        """A hundredth of the sensor's white noise per sample."""
        return WALK * level

    def rescaled(self, values: Mapping[str, float], own: float, dt: float) -> float:
        """Its variance grows with time."""
        return float(np.sqrt(dt / own))

    def start(
        self, place: Place, level: FloatArray, seen: Mapping[str, FloatArray]
    ) -> tuple[FloatArray, FloatArray]:
        """Zero within a tenth of the sensor's white noise."""
        return np.zeros(level.size), level * FRESH

    def renewed(self, values: Mapping[str, float], dt: float) -> float:
        """1: a walk has no stationary variance, its steps are held against white noise."""
        return 1.0

    def described(self, level: float, values: Mapping[str, float], dt: float) -> dict[str, float]:
        """`sigma` after one second."""
        return {"sigma": level / np.sqrt(dt)}
