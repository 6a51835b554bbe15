"""Delay: a sensor that shows its reading up to one sample late, exact for readings that are linear
over a sample.

    y_k = (1 - d/dt) r_k + d/dt r_k-1,    the state is r_k-1

r is the reading of the sensor with noise w in front of the delay. Delays of all inertial sensors,
or of the pose, of any length are effects (`sensor_delay`, `pose_delay`); this part is for one
sensor that is later than the others.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from greybox.errors import ModelError
from greybox.model.dynamics import Dynamics
from greybox.model.layer import physics_of
from greybox.model.noise.part import Place, SensorPart
from greybox.model.parameter import Parameter
from greybox.symbolic import Expr, FloatArray

START_SPREAD = 10.0
"""Spread of the state at the start in units of the sensor's white noise: its first reading is
hardly the one before it."""
SHORTEST = 1e-6
"""Delay [s] below which the continuous model follows no faster."""


@dataclass(frozen=True, kw_only=True)
class Delay(SensorPart):
    """Every component of `sensor` is late by d; `time` [s] is the start value of d, at most one
    sample."""

    kind = "delay"
    quantities = ("d",)
    filters = True
    time: float = 0.0

    def parameters(self, core: Dynamics) -> tuple[Parameter, ...]:
        """d [s], one for all components, from none to one sample. Raises `ModelError` for a model that is
        no physics."""
        physics = physics_of(core)
        if physics is None:
            raise ModelError(f"{core.name} has no sample time", expected="a physics model")
        dt = physics.sample_time
        return (
            Parameter(
                name=f"{self.name}.d",
                unit="s",
                nominal=self.time,
                lower=0.0,
                upper=dt,
                null=0.0,
                scale=0.3 * dt,
                meaning=f"delay, {self.sensor}",
            ),
        )

    def rate(self, c: Expr, values: Mapping[str, Expr], reading: Expr) -> Expr:
        """(r - c)/d: to first order in d."""
        return (reading - c) / ca.fmax(values["d"], SHORTEST)

    def step(self, c: Expr, w: Expr, values: Mapping[str, Expr], reading: Expr, dt: Expr) -> Expr:
        """The reading of this sample."""
        return reading + w

    def shown(self, c: Expr, w: Expr, values: Mapping[str, Expr], reading: Expr, dt: Expr) -> Expr:
        """Between the reading and the one before it."""
        share = values["d"] / dt
        return (1 - share) * (reading + w) + share * c

    def driving(self, level: FloatArray, dt: float) -> FloatArray:
        """As much noise in front of the delay as the sensor has white noise."""
        return 1.0 * level

    def rescaled(self, values: Mapping[str, float], own: float, dt: float) -> float:
        """1: so much per sample, whatever the rate, as other noise of sensors."""
        return 1.0

    def start(
        self, place: Place, level: FloatArray, seen: Mapping[str, FloatArray]
    ) -> tuple[FloatArray, FloatArray]:
        """What its sensor shows first."""
        first = [next(iter(seen.get(n, ())), np.nan) for n in place.readings]
        return np.nan_to_num(np.array(first, dtype=float)), START_SPREAD * level

    def settled(self, place: Place, means: Mapping[str, float]) -> FloatArray:
        """The mean of its sensor."""
        return np.array([means.get(n, 0.0) for n in place.readings])

    def renewed(self, values: Mapping[str, float], dt: float) -> float:
        """1: the noise in front of the delay is white."""
        return 1.0

    def described(self, level: float, values: Mapping[str, float], dt: float) -> dict[str, float]:
        """`delay` [s] and `sigma` of the noise in front of it."""
        return {"delay": float(values[f"{self.name}.d"]), "sigma": level}

    def estimated(self, values: Mapping[str, float]) -> Delay:
        """The same with its estimated delay."""
        return replace(self, time=float(values[f"{self.name}.d"]))
