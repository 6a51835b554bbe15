"""Coloured: first-order Gauss-Markov noise of a sensor, c+ = exp(-dt/T) c + w.

(Bryson and Johansen 1965, IEEE Trans. Automatic Control 10(1): coloured measurement noise as states
of the filter.)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from greybox.model.dynamics import Dynamics
from greybox.model.noise import gauss_markov
from greybox.model.noise.part import SensorPart
from greybox.model.parameter import Parameter
from greybox.symbolic import Expr, FloatArray


@dataclass(frozen=True, kw_only=True)
class Coloured(SensorPart):
    """Gauss-Markov noise on every component of `sensor`; `time` [s] is the start value of its
    correlation time T."""

    kind = "coloured"
    quantities = ("T",)
    lasting = True
    time: float = 0.1

    def parameters(self, core: Dynamics) -> tuple[Parameter, ...]:
        """T [s], one for all components (bounds 0.001 .. 100 s: as long as flights last)."""
        return (
            Parameter(
                name=f"{self.name}.T",
                unit="s",
                nominal=self.time,
                lower=0.001,
                upper=100.0,
                scale=self.time,
                meaning=f"time constant, {self.kind} {self.sensor}",
            ),
        )

    def rate(self, c: Expr, values: Mapping[str, Expr], reading: Expr) -> Expr:
        """-c/T."""
        return -c / values["T"]

    def step(self, c: Expr, w: Expr, values: Mapping[str, Expr], reading: Expr, dt: Expr) -> Expr:
        """exp(-dt/T) c + w."""
        return gauss_markov.kept(values["T"], dt) * c + w

    def driving(self, level: FloatArray, dt: float) -> FloatArray:
        """As much noise as the white noise of its sensor, at the start value of T."""
        return float(np.sqrt(gauss_markov.renewed(self.time, dt))) * level

    def rescaled(self, values: Mapping[str, float], own: float, dt: float) -> float:
        """Its stationary variance stays."""
        return gauss_markov.rescaled(float(values[f"{self.name}.T"]), own, dt)

    def renewed(self, values: Mapping[str, float], dt: float) -> float:
        """1 - exp(-2 dt/T)."""
        return gauss_markov.renewed(float(values[f"{self.name}.T"]), dt)

    def described(self, level: float, values: Mapping[str, float], dt: float) -> dict[str, float]:
        """`sigma` of the noise itself and `T` [s]."""
        return gauss_markov.described(level, values, dt, self.name)

    def estimated(self, values: Mapping[str, float]) -> Coloured:
        """The same with its estimated correlation time."""
        return replace(self, time=float(values[f"{self.name}.T"]))
