"""Line: narrow-band noise of a sensor about one frequency, as rotors leave it.

(c, s)+ = exp(-dt/T) R(2 pi f dt) (c, s) + w,    the sensor shows c
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from greybox.errors import ModelError
from greybox.model.dynamics import Dynamics
from greybox.model.layer import physics_of
from greybox.model.noise import gauss_markov
from greybox.model.noise.part import SensorPart
from greybox.model.parameter import Parameter
from greybox.symbolic import Expr, FloatArray


@dataclass(frozen=True, kw_only=True)
class Line(SensorPart):
    """A line on every component of `sensor`; `time` [s] and `frequency` [Hz] are start values of
    its decay time T and f."""

    kind = "line"
    quantities = ("T", "f")
    copies = ("c", "s")
    time: float = 0.1
    frequency: float = 0.0

    def parameters(self, core: Dynamics) -> tuple[Parameter, ...]:
        """T [s] and f [Hz] up to half the sampling rate, one each for all components. Raises `ModelError` for
        a model that is no physics."""
        physics = physics_of(core)
        if physics is None:
            raise ModelError(f"{core.name} has no sample time", expected="a physics model")
        return (
            Parameter(
                name=f"{self.name}.T",
                unit="s",
                nominal=self.time,
                lower=0.001,
                upper=1.0,
                scale=self.time,
                meaning=f"time constant, {self.kind} {self.sensor}",
            ),
            Parameter(
                name=f"{self.name}.f",
                unit="Hz",
                nominal=self.frequency,
                lower=0.0,
                upper=0.5 / physics.sample_time,
                scale=0.1,
                meaning=f"frequency of the line, {self.sensor}",
            ),
        )

    def rate(self, c: Expr, values: Mapping[str, Expr], reading: Expr) -> Expr:
        """-c/T: the decay alone, the turning is left out."""
        return -c / values["T"]

    def step(self, c: Expr, w: Expr, values: Mapping[str, Expr], reading: Expr, dt: Expr) -> Expr:
        """Turned by 2 pi f dt, decayed by exp(-dt/T), plus w."""
        n, angle = c.shape[0] // 2, 2 * np.pi * values["f"] * dt
        a, b = c[:n], c[n:]
        turned = ca.vertcat(
            ca.cos(angle) * a - ca.sin(angle) * b, ca.sin(angle) * a + ca.cos(angle) * b
        )
        return gauss_markov.kept(values["T"], dt) * turned + w

    def driving(self, level: FloatArray, dt: float) -> FloatArray:
        """As much noise as the white noise of its sensor, at the start value of T."""
        return float(np.sqrt(gauss_markov.renewed(self.time, dt))) * np.concatenate([level, level])

    def rescaled(self, values: Mapping[str, float], own: float, dt: float) -> float:
        """Its stationary variance stays."""
        return gauss_markov.rescaled(float(values[f"{self.name}.T"]), own, dt)

    def renewed(self, values: Mapping[str, float], dt: float) -> float:
        """1 - exp(-2 dt/T)."""
        return gauss_markov.renewed(float(values[f"{self.name}.T"]), dt)

    def described(self, level: float, values: Mapping[str, float], dt: float) -> dict[str, float]:
        """`sigma` of the noise itself, `T` [s] and `frequency` [Hz]."""
        return {
            **gauss_markov.described(level, values, dt, self.name),
            "frequency": float(values[f"{self.name}.f"]),
        }

    def estimated(self, values: Mapping[str, float]) -> Line:
        """The same with its estimated decay time and frequency."""
        return replace(
            self, time=float(values[f"{self.name}.T"]), frequency=float(values[f"{self.name}.f"])
        )
