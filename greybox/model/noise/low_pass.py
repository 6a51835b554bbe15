"""LowPass: a first-order filter of a sensor, exact for readings that are linear over a sample.

    y_k = keep y_k-1 + new r_k + old r_k-1
    keep = exp(-dt/T),   q = T/dt (1 - keep),   new = 1 - q,   old = q - keep

r is the reading of the sensor with noise w in front of the filter; the state is what the past adds
to the next reading.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from greybox.model.dynamics import Dynamics
from greybox.model.noise import gauss_markov
from greybox.model.noise.part import Place, SensorPart
from greybox.model.parameter import Parameter
from greybox.symbolic import Expr, FloatArray

FILTERED = ("gyro", "accelerometer")
"""Sensors that firmware filters before it logs them: those of the IMU."""
SLOWEST = 1 / (2 * np.pi * 5.0)
"""Longest T [s]: 5 Hz, half of the lowest cut-off that firmware sets for an IMU (10 Hz, ArduPilot's
INS_ACCEL_FILTER; Crazyflie 30, PX4 30). What is slower is a lag of the craft, not of its sensor."""
START_SPREAD = 10.0
"""Spread of the state at the start in units of the sensor's white noise, beside half of what the
sensor shows first."""


@dataclass(frozen=True, kw_only=True)
class LowPass(SensorPart):
    """A filter of every component of `sensor`; `time` [s] is the start value of T."""

    kind = "low_pass"
    quantities = ("T",)
    filters = True
    time: float = 0.005

    def parameters(self, core: Dynamics) -> tuple[Parameter, ...]:
        """T [s], one for all components."""
        return (
            Parameter(
                name=f"{self.name}.T",
                unit="s",
                nominal=self.time,
                lower=0.001,
                upper=max(SLOWEST, self.time),  # a file of before may hold a slower one
                scale=self.time,
                meaning=f"time constant, {self.kind} {self.sensor}",
            ),
        )

    def rate(self, c: Expr, values: Mapping[str, Expr], reading: Expr) -> Expr:
        """(r - c)/T."""
        return (reading - c) / values["T"]

    def step(self, c: Expr, w: Expr, values: Mapping[str, Expr], reading: Expr, dt: Expr) -> Expr:
        """What this reading and those before it add to the next one."""
        r = reading + w
        keep, new, old = _weights(values["T"], dt)
        return keep * (c + new * r) + old * r

    def shown(self, c: Expr, w: Expr, values: Mapping[str, Expr], reading: Expr, dt: Expr) -> Expr:
        """The filtered reading."""
        _, new, _ = _weights(values["T"], dt)
        return c + new * (reading + w)

    def driving(self, level: FloatArray, dt: float) -> FloatArray:
        """As much noise in front of the filter as the sensor has white noise."""
        return 1.0 * level

    def rescaled(self, values: Mapping[str, float], own: float, dt: float) -> float:
        """1: so much per sample, whatever the rate, as other noise of sensors."""
        return 1.0

    def start(
        self, place: Place, level: FloatArray, seen: Mapping[str, FloatArray]
    ) -> tuple[FloatArray, FloatArray]:
        """Between nothing and all of what its sensor shows first."""
        first = [next(iter(seen.get(n, ())), np.nan) for n in place.readings]
        half = 0.5 * np.nan_to_num(np.array(first, dtype=float))
        return half, START_SPREAD * level + np.abs(half)

    def settled(self, place: Place, means: Mapping[str, float]) -> FloatArray:
        """The mean of its sensor."""
        return np.array([means.get(n, 0.0) for n in place.readings])

    def renewed(self, values: Mapping[str, float], dt: float) -> float:
        """1: the noise in front of the filter is white."""
        return 1.0

    def described(self, level: float, values: Mapping[str, float], dt: float) -> dict[str, float]:
        """`T` [s], `cutoff` [Hz] and `sigma` of the noise in front of the filter."""
        time = float(values[f"{self.name}.T"])
        return {"T": time, "cutoff": 1 / (2 * np.pi * time), "sigma": level}

    def estimated(self, values: Mapping[str, float]) -> LowPass:
        """The same with its estimated time constant."""
        return LowPass(sensor=self.sensor, time=float(values[f"{self.name}.T"]))


def _weights(time: Expr, dt: Expr) -> tuple[Expr, Expr, Expr]:
    """(keep, new, old): y_k = keep y_k-1 + new r_k + old r_k-1 for readings that are linear over
    the sample."""
    keep = gauss_markov.kept(time, dt)
    ratio = time / dt * (1 - keep)
    return keep, 1 - ratio, ratio - keep
