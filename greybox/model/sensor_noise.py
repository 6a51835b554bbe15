"""SensorNoise: any Dynamics whose sensors have noise that is correlated in time, or filter what they measure.

A sensor's own noise c adds to its innovation and to nothing else, e = y - h(x) - c: the vehicle does not feel it. That
is what tells it from a disturbance of force or torque, which reaches every sensor that the motion reaches. Kinds:

    coloured   c+ = exp(-dt/T) c + w, first-order Gauss-Markov noise
    drift      c+ = c + w, a random walk
    line       (c, s)+ = exp(-dt/T) R(2 pi f dt) (c, s) + w, a narrow line at f [Hz], as rotors leave it
    low_pass   a first-order filter with time constant T, exact for readings that are linear over a sample; of the
               reading and of noise w in front of the filter

(Bryson and Johansen 1965, IEEE Trans. Automatic Control 10(1): coloured measurement noise as states of the filter;
El-Sheimy, Hou and Niu 2008, IEEE Trans. Instrumentation and Measurement 57(1): what noise inertial sensors have.)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from greybox.errors import ModelError, UnknownNameError
from greybox.model.dynamics import Dynamics
from greybox.model.parameter import Parameter
from greybox.symbolic import Expr, FloatArray, Layout, Signal

KINDS = ("coloured", "drift", "line", "low_pass")
FRESH = 0.1
"""Spread of a drift at the start, as a share of its sensor's white noise."""


@dataclass(frozen=True, kw_only=True)
class NoisePart:
    """One kind of noise on one sensor: `sensor` is a name of `greybox.model.sensors`; `time` [s] and `frequency` [Hz] are
    the start values of its parameters (`low_pass`: the time constant of the filter)."""

    sensor: str
    kind: str
    time: float = 0.1
    frequency: float = 0.0

    @property
    def name(self) -> str:
        """kind.sensor, the prefix of its states and parameters."""
        return f"{self.kind}.{self.sensor}"


@dataclass(frozen=True, kw_only=True)
class SensorNoise:
    """`inner` with the noise `parts`; every component of a sensor has its own states and levels, the sensor one time
    constant `<kind>.<sensor>.T` [s] and one frequency `line.<sensor>.f` [Hz].

    Raises `ModelError` for an unknown kind or a part given twice, `UnknownNameError` for a sensor that is not there.
    """

    inner: Any
    parts: tuple[NoisePart, ...]

    def __post_init__(self) -> None:
        known = [s.name for s in self.inner.sensors]
        for part in self.parts:
            if part.sensor not in known:
                raise UnknownNameError("sensor", part.sensor, known)
            if part.kind not in KINDS:
                raise ModelError(f"noise of kind '{part.kind}'", expected=f"one of {', '.join(KINDS)}")
        names = [p.name for p in self.parts]
        if double := sorted({n for n in names if names.count(n) > 1}):
            raise ModelError(f"sensor noise given twice: {', '.join(double)}")

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name == "inner":
            raise AttributeError(name)
        return getattr(self.inner, name)

    # ---------------------------------------------------------------- layouts

    @cached_property
    def _rows(self) -> dict[str, tuple[range, range]]:
        """Sensor -> places of its components among the innovations, and of its columns among the outputs."""
        out, e, y = {}, 0, 0
        for s in self.inner.sensors:
            ne, ny = len(s.innovation_signals(self.inner.vehicle)), len(s.signals(self.inner.vehicle))
            out[s.name] = (range(e, e + ne), range(y, y + ny))
            e, y = e + ne, y + ny
        return out

    def _signals(self, prefix: str) -> list[Signal]:
        out = []
        for part in self.parts:
            rows, _ = self._rows[part.sensor]
            for letter in ("c", "s") if part.kind == "line" else ("c",):
                for i in rows:
                    s = self.inner.innovations.signals[i]
                    name = f"{prefix}{part.name}.{letter}.{s.name.split('.')[-1]}"
                    out.append(Signal(name=name, unit=s.unit, meaning=f"{part.kind} noise, {s.meaning}"))
        return out

    @property
    def name(self) -> str:
        """Name of the inner model and the parts."""
        return f"{self.inner.name}, sensor noise {', '.join(p.name for p in self.parts) or 'white'}"

    @cached_property
    def states(self) -> Layout:
        """Inner states, then those of the parts."""
        return Layout([*self.inner.states.signals, *self._signals("")])

    @cached_property
    def error_states(self) -> Layout:
        """Inner error states, then those of the parts."""
        return Layout([*self.inner.error_states.signals, *self._signals("d_")])

    @cached_property
    def noises(self) -> Layout:
        """Inner noises, then what drives the parts."""
        return Layout([*self.inner.noises.signals, *self._signals("")])

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Inner parameters, then those of the parts."""
        own = []
        for part in self.parts:
            if part.kind != "drift":
                own.append(
                    Parameter(
                        name=f"{part.name}.T", unit="s", nominal=part.time, lower=0.001,
                        upper=0.1 if part.kind == "low_pass" else 1.0, scale=part.time,
                        meaning=f"time constant, {part.kind} {part.sensor}",
                    )
                )  # fmt: skip
            if part.kind == "line":
                own.append(
                    Parameter(
                        name=f"{part.name}.f", unit="Hz", nominal=part.frequency, lower=0.0,
                        upper=0.5 / self.inner.sample_time, scale=0.1, meaning=f"frequency of the line, {part.sensor}",
                    )
                )  # fmt: skip
        return (*self.inner.parameters, *own)

    def without_effect(self, *names: str) -> SensorNoise:
        """The same noise on the model without these effects."""
        return SensorNoise(inner=self.inner.without_effect(*names), parts=self.parts)

    def with_effect(self, *effects: Any) -> SensorNoise:
        """The same noise on the model with further effects."""
        return SensorNoise(inner=self.inner.with_effect(*effects), parts=self.parts)

    # ---------------------------------------------------------------- dynamics

    def _split(self, x: Expr) -> tuple[Expr, dict[str, Expr]]:
        """(inner state, states of each part)."""
        at = len(self.inner.states)
        out = {}
        for part in self.parts:
            size = len(self._rows[part.sensor][0]) * (2 if part.kind == "line" else 1)
            out[part.name] = x[at : at + size]
            at += size
        return x[: len(self.inner.states)], out

    def _p(self, p: Expr) -> Expr:
        return p[: len(self.inner.parameters)]

    def _w(self, w: Expr) -> Expr:
        return None if w is None else w[: len(self.inner.noises)]

    def _own(self, p: Expr) -> dict[str, Expr]:
        n = len(self.inner.parameters)
        return {d.name: p[n + i] for i, d in enumerate(self.parameters[n:])}

    def f(self, t: Expr, x: Expr, u: Expr, p: Expr, w: Expr = None) -> Expr:
        """Inner derivative; noise decays with its time constant (its frequency left out) and filters follow."""
        xi, own = self._split(x)
        values, rates = self._own(p), []
        reading = self.inner.h(t, xi, u, self._p(p), self._w(w))
        for part in self.parts:
            c = own[part.name]
            target: Expr = c * 0
            if part.kind == "low_pass":
                target = reading[list(self._rows[part.sensor][1])]
            rates.append(c * 0 if part.kind == "drift" else (target - c) / values[f"{part.name}.T"])
        return ca.vertcat(self.inner.f(t, xi, u, self._p(p), self._w(w)), *rates)

    def h(self, t: Expr, x: Expr, u: Expr, p: Expr, w: Expr = None) -> Expr:
        """Inner outputs; a filtered sensor shows the state of its filter. Noise is part of the innovation alone."""
        xi, own = self._split(x)
        y = self.inner.h(t, xi, u, self._p(p), self._w(w))
        return self._shown(y, {p.sensor: own[p.name] for p in self.parts if p.kind == "low_pass"})

    def _shown(self, y: Expr, readings: Mapping[str, Expr]) -> Expr:
        pieces = [readings.get(s.name, y[list(self._rows[s.name][1])]) for s in self.inner.sensors]
        return ca.vertcat(*pieces)

    def step(self, t: Expr, x: Expr, window: Expr, p: Expr, w: Expr, dt: Expr) -> Expr:
        """Inner step, exact steps of the noise; a filter keeps what the next reading needs of this one."""
        xi, own = self._split(x)
        values, after, at = self._own(p), [], len(self.inner.noises)
        reading: Expr = None
        for part in self.parts:
            c = own[part.name]
            size = c.shape[0]
            if part.kind == "low_pass":
                if reading is None:
                    reading = self.inner.output(t, xi, window, self._p(p), self._w(w), dt)
                r = reading[list(self._rows[part.sensor][1])] + w[at : at + size]
                keep, new, old = _filter(values[f"{part.name}.T"], dt)
                c = keep * (c + new * r) + old * r
            elif part.kind == "drift":
                c = c + w[at : at + size]
            else:
                decay = ca.exp(-dt / values[f"{part.name}.T"])
                if part.kind == "line":
                    n, angle = size // 2, 2 * np.pi * values[f"{part.name}.f"] * dt
                    a, b = c[:n], c[n:]
                    c = ca.vertcat(ca.cos(angle) * a - ca.sin(angle) * b, ca.sin(angle) * a + ca.cos(angle) * b)
                c = decay * c + w[at : at + size]
            after.append(c)
            at += size
        return ca.vertcat(self.inner.step(t, xi, window, self._p(p), self._w(w), dt), *after)

    def output(self, t: Expr, x: Expr, window: Expr, p: Expr, w: Expr, dt: Expr) -> Expr:
        """Inner outputs, those of filtered sensors through their filter."""
        xi, own = self._split(x)
        y = self.inner.output(t, xi, window, self._p(p), self._w(w), dt)
        values, readings, at = self._own(p), {}, len(self.inner.noises)
        for part in self.parts:
            size = own[part.name].shape[0]
            if part.kind == "low_pass":
                _, new, _ = _filter(values[f"{part.name}.T"], dt)
                r = y[list(self._rows[part.sensor][1])] + w[at : at + size]
                readings[part.sensor] = own[part.name] + new * r
            at += size
        return self._shown(y, readings)

    def innovation(self, y: Expr, y_hat: Expr, x: Expr) -> Expr:
        """That of the inner model less the sensors' own noise."""
        xi, own = self._split(x)
        e = self.inner.innovation(y, y_hat, xi)
        pieces = []
        for s in self.inner.sensors:
            rows = self._rows[s.name][0]
            c: Expr = 0
            for part in self.parts:
                if part.sensor == s.name and part.kind != "low_pass":
                    c = c + own[part.name][: len(rows)]
            pieces.append(e[list(rows)] - c)
        return ca.vertcat(*pieces)

    def boxplus(self, x: Expr, d: Expr) -> Expr:
        """Inner chart, noise by addition."""
        n, nd = len(self.inner.states), len(self.inner.error_states)
        return ca.vertcat(self.inner.boxplus(x[:n], d[:nd]), x[n:] + d[nd:])

    def boxminus(self, x2: Expr, x1: Expr) -> Expr:
        """Inner chart, noise by subtraction."""
        n = len(self.inner.states)
        return ca.vertcat(self.inner.boxminus(x2[:n], x1[:n]), x2[n:] - x1[n:])

    # ---------------------------------------------------------------- starts

    def _scales(self) -> FloatArray:
        """Typical size of every own state at the start: the start value of its sensor's white noise, of a drift a part."""
        white = self.inner.sensor_scale()
        sizes = []
        for part in self.parts:
            level = white[list(self._rows[part.sensor][0])] * (FRESH if part.kind == "drift" else 1.0)
            sizes.append(np.concatenate([level, level]) if part.kind == "line" else level)
        return np.concatenate(sizes) if sizes else np.zeros(0)

    def reference(self, means: Mapping[str, float]) -> FloatArray:
        """Inner reference, no noise; filters show the mean of their sensor."""
        out = []
        for part in self.parts:
            rows, columns = self._rows[part.sensor]
            size = len(rows) * (2 if part.kind == "line" else 1)
            if part.kind == "low_pass":
                out.append(np.array([means.get(self.inner.outputs.names[i], 0.0) for i in columns]))
            else:
                out.append(np.zeros(size))
        return np.concatenate([self.inner.reference(means), *out])

    def initial_state(self, start: Mapping[str, FloatArray]) -> tuple[FloatArray, FloatArray]:
        """Inner start; noise starts at zero with the spread of the sensor's white noise, a drift with a tenth of that (what
        a sensor is off by from the start is a bias, an effect with a name), a filter between nothing and all of what its
        sensor shows first (its state is what the past adds to the reading)."""
        x0, sigma = self.inner.initial_state(start)
        spread = self._scales()
        begin: list[FloatArray] = []
        for part in self.parts:
            rows, columns = self._rows[part.sensor]
            size = len(rows) * (2 if part.kind == "line" else 1)
            if part.kind == "low_pass":
                first = [np.asarray(start.get(self.inner.outputs.names[i], [np.nan]))[:1] for i in columns]
                half = 0.5 * np.nan_to_num(np.concatenate(first))
                at = sum(b.size for b in begin)
                spread[at : at + half.size] = 10.0 * spread[at : at + half.size] + np.abs(half)
                begin.append(half)
            else:
                begin.append(np.zeros(size))
        return np.concatenate([x0, *begin]), np.concatenate([sigma, spread])

    def noise_scale(self, dt: float) -> FloatArray:
        """Inner scales; each part as much as the white noise of its sensor, a drift a hundredth of it per sample."""
        white, own = self.inner.sensor_scale(), []
        for part in self.parts:
            level = white[list(self._rows[part.sensor][0])]
            share = {"drift": 0.01, "low_pass": 1.0}.get(part.kind, float(np.sqrt(1 - np.exp(-2 * dt / part.time))))
            own.append(share * (np.concatenate([level, level]) if part.kind == "line" else level))
        return np.concatenate([self.inner.noise_scale(dt), *own])

    def sensor_scale(self) -> FloatArray:
        """As the inner model."""
        return self.inner.sensor_scale()


def _filter(time: Expr, dt: Expr) -> tuple[Expr, Expr, Expr]:
    """(keep, new, old): y_k = keep y_k-1 + new r_k + old r_k-1 for readings that are linear over the sample."""
    keep = ca.exp(-dt / time)
    ratio = time / dt * (1 - keep)
    return keep, 1 - ratio, ratio - keep


def white(dynamics: Dynamics) -> Dynamics:
    """The model without sensor noise states."""
    return dynamics.inner if isinstance(dynamics, SensorNoise) else dynamics
