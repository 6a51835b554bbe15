"""Augmented: a Dynamics and the noise that is correlated in time, as one model with more states.

    x = (core's x, own states of every part)
    w = (core's w, driving noise of every part); disturbances push the core's w
    e = core's e - own noise of the sensors; filtered sensors show their filter

What errs in the world's axes enters e turned into the body's, and is driven and corrected in those:
so the gain of the filter is one for all headings.

White noise is no parts. Parts of sensors come first, in the order in which they were added, then
disturbances in the order of the process noise. What the parts are is in their own files.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import casadi as ca
import numpy as np

from greybox.errors import ModelError
from greybox.frames import rotation_matrix
from greybox.model.dynamics import Dynamics
from greybox.model.layer import Layer, layers
from greybox.model.noise.disturbance import Disturbance
from greybox.model.noise.gust import Gust
from greybox.model.noise.part import NoisePart, Place, SensorPart
from greybox.model.parameter import Parameter
from greybox.symbolic import BoolArray, Expr, FloatArray, Layout, Signal, given, sum_of

START_STEP = 0.01
"""Sample time [s] whose typical noise levels are the spread of own states at the start of a
flight."""


class _Placed(NamedTuple):
    """A part with its place in the core, and its own states, noises and parameters among those of
    all parts."""

    part: NoisePart
    place: Place
    own: slice
    quantities: slice


@dataclass(frozen=True, kw_only=True, repr=False)
class Augmented(Layer):
    """`core` with the noise `parts`. An augmented core gives up its parts: one model, more parts.

    Raises `UnknownNameError` for a part whose place is not there, `ModelError` for a part that is
    there twice and for two filters of one sensor.
    """

    core: Dynamics
    parts: tuple[NoisePart, ...]

    def __post_init__(self) -> None:
        core, parts = self.core, tuple(self.parts)
        if isinstance(self.core, Augmented):
            core, parts = self.core.core, (*self.core.parts, *parts)
        names = [p.name for p in parts]
        if double := sorted({n for n in names if names.count(n) > 1}):
            raise ModelError(f"noise given twice: {', '.join(double)}")
        filtered = [p.sensor for p in parts if isinstance(p, SensorPart) and p.filters]
        if len(set(filtered)) < len(filtered):
            raise ModelError(
                "two filters of one sensor", got=", ".join(filtered), fix="keep one of them"
            )
        places = [p.place(core) for p in parts]
        # Disturbances behind the noise of sensors, in the order of what they push.
        order = sorted(
            range(len(parts)),
            key=lambda i: places[i].rows[0] if isinstance(parts[i], Disturbance) else -1,
        )
        object.__setattr__(self, "core", core)
        object.__setattr__(self, "parts", tuple(parts[i] for i in order))

    @property
    def base(self) -> Dynamics:
        """The model that the parts were added to."""
        return self.core

    def on(self, base: Dynamics) -> Augmented:
        """The same parts on another model."""
        return replace(self, core=base)

    # ---------------------------------------------------------------- layouts

    @cached_property
    def _placed(self) -> tuple[_Placed, ...]:
        out, at, q = [], 0, 0
        for part in self.parts:
            place = part.place(self.core)
            size = len(part.signals(place))
            own, quantities = slice(at, at + size), slice(q, q + len(part.quantities))
            out.append(_Placed(part=part, place=place, own=own, quantities=quantities))
            at, q = own.stop, quantities.stop
        return tuple(out)

    @cached_property
    def _signals(self) -> tuple[Signal, ...]:
        return tuple(s for placed in self._placed for s in placed.part.signals(placed.place))

    def _acting(self, chosen: Iterable[_Placed], size: int) -> Expr:
        """Matrix (size, own states) that adds what acts of these parts to what is at their
        places."""
        e = ca.DM(size, len(self._signals))
        for _, place, own, _ in chosen:
            for j, i in enumerate(place.rows):
                e[i, own.start + j] = 1.0
        return e

    @cached_property
    def _pushes(self) -> Expr:
        disturbing = [a for a in self._placed if isinstance(a.part, Disturbance)]
        return self._acting(disturbing, len(self.core.noises))

    @cached_property
    def _errs(self) -> Expr:
        erring = [a for a in self._placed if isinstance(a.part, SensorPart) and not a.part.filters]
        return self._acting(erring, len(self.core.innovations))

    @property
    def name(self) -> str:
        """Name of the core, then the sensors' own noise and the disturbed groups, where there are
        any."""
        own = ", ".join(p.name for p in self.parts if not isinstance(p, Disturbance))
        groups = ", ".join(p.group for p in self.parts if isinstance(p, Disturbance))
        sensors = f", sensor noise {own}" if own else ""
        return self.core.name + sensors + (f", disturbance {groups}" if groups else "")

    @cached_property
    def states(self) -> Layout:
        """States of the core, then those of the parts."""
        return Layout([*self.core.states.signals, *self._signals])

    @cached_property
    def error_states(self) -> Layout:
        """Error states of the core, then those of the parts."""
        own = [replace(s, name=f"d_{s.name}") for s in self._signals]
        return Layout([*self.core.error_states.signals, *own])

    @cached_property
    def noises(self) -> Layout:
        """Noises of the core, then what drives the parts."""
        return Layout([*self.core.noises.signals, *self._signals])

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters of the core, then those of the parts."""
        return (
            *self.core.parameters,
            *(d for part in self.parts for d in part.parameters(self.core)),
        )

    def rescaled(self, values: Mapping[str, float], own: float, dt: float) -> FloatArray:
        """Factors (n_w,) from noise levels per sample of `own` seconds to those per sample of `dt`:
        white noise of the core keeps its intensity, variance times sample time."""
        white = np.full(len(self.core.noises), np.sqrt(own / dt))
        each = [
            np.full(a.own.stop - a.own.start, a.part.rescaled(values, own, dt))
            for a in self._placed
        ]
        return np.concatenate([white, *each])

    # ---------------------------------------------------------------- motion

    def _split(self, x: Expr) -> tuple[Expr, Expr]:
        """(core's x, own states of all parts)."""
        n = len(self.core.states)
        return x[:n], x[n:]

    def _core_p(self, p: Expr) -> Expr:
        return p[: len(self.core.parameters)]

    def _turned(self, core: Expr, own: Expr, *, into_world: bool = True) -> Expr:
        """What is in body axes of all own states, with those of the world's axes turned there; or
        back."""
        if not any(a.place.world for a in self._placed):
            return own
        rotation = rotation_matrix(core[[self.core.states[f"attitude.{c}"] for c in "wxyz"]])
        turn = rotation if into_world else rotation.T
        out = []
        for a in self._placed:
            mine = own[a.own]
            if a.place.world:
                mine = ca.vec(turn @ ca.reshape(mine, 3, len(a.part.copies)))
            out.append(mine)
        return ca.vertcat(*out)

    def _values(self, placed: _Placed, p: Expr) -> dict[str, Expr]:
        """Short name -> value of the part's parameters."""
        n = len(self.core.parameters) + placed.quantities.start
        return {q: p[n + i] for i, q in enumerate(placed.part.quantities)}

    def _white(self, w: Expr) -> Expr:
        """White process noise of the core."""
        return None if w is None else w[: len(self.core.noises)]

    def _push(self, own: Expr) -> Expr:
        """What the disturbances push, in the channels of the core's process noise."""
        return self._pushes @ own if self._pushes.nnz() else None

    def _pushed(self, own: Expr, w: Expr) -> Expr:
        """Process noise of the core with the disturbances on top."""
        return sum_of(self._white(w), self._push(own))

    def _of_sensor(self, placed: _Placed, y: Expr) -> Expr:
        """Readings of the part's sensor; None for parts of other places and where nothing reads
        them."""
        return None if y is None else y[list(placed.place.columns)]

    def _reading(self, placed: _Placed, core: Expr, y: Expr) -> Expr:
        """What the step of a part looks at: a filter at its sensor, a gust at the body's rate."""
        if isinstance(placed.part, Gust):
            return core[[self.core.states[f"rate.{a}"] for a in "xyz"]]
        return self._of_sensor(placed, y) if placed in self._filters else None

    @cached_property
    def _filters(self) -> tuple[_Placed, ...]:
        return tuple(a for a in self._placed if isinstance(a.part, SensorPart) and a.part.filters)

    def _shown(self, y: Expr, readings: Mapping[int, Expr]) -> Expr:
        """y with the readings of filtered sensors, by their first column, in place of their own."""
        pieces, at = [], 0
        for column, reading in sorted(readings.items()):
            pieces += [y[at:column], reading]
            at = column + reading.shape[0]
        return ca.vertcat(*pieces, y[at:]) if pieces else y

    def f(self, t: Expr, x: Expr, u: Expr, p: Expr, w: Expr = None) -> Expr:
        """Core's derivative under the disturbances; noise decays, filters follow."""
        core, own = self._split(x)
        pushed = self._pushed(own, w)
        y = self.core.h(t, core, u, self._core_p(p), pushed) if self._filters else None
        rates = [
            a.part.rate(
                own[a.own],
                self._values(a, p),
                self._reading(a, core, y),
            )
            for a in self._placed
        ]
        return ca.vertcat(self.core.f(t, core, u, self._core_p(p), pushed), *rates)

    def h(self, t: Expr, x: Expr, u: Expr, p: Expr, w: Expr = None) -> Expr:
        """Core's outputs; disturbances reach the accelerometer, a filtered sensor shows the state
        of its filter. A sensor's own noise is part of the innovation alone."""
        core, own = self._split(x)
        y = self.core.h(t, core, u, self._core_p(p), self._pushed(own, w))
        return self._shown(y, {a.place.columns[0]: own[a.own] for a in self._filters})

    def step(self, t: Expr, x: Expr, window: Expr, p: Expr, w: Expr, dt: Expr) -> Expr:
        """Core's step with the disturbances held over it, and the step of every part."""
        core, own = self._split(x)
        pushed = self._pushed(own, w)
        driving = self._turned(core, w[len(self.core.noises) :])
        y = (
            self.core.output(
                t, core, window, self._core_p(p), self._white(w), dt, *given(self._push(own))
            )
            if self._filters
            else None
        )
        after = [
            a.part.step(
                own[a.own],
                driving[a.own],
                self._values(a, p),
                self._reading(a, core, y),
                dt,
            )
            for a in self._placed
        ]
        return ca.vertcat(self.core.step(t, core, window, self._core_p(p), pushed, dt), *after)

    def output(
        self,
        t: Expr,
        x: Expr,
        window: Expr,
        p: Expr,
        w: Expr,
        dt: Expr,
        lasting: Expr = None,
    ) -> Expr:
        """Core's outputs under the disturbances, those of filtered sensors through their filter."""
        core, own = self._split(x)
        driving = w[len(self.core.noises) :]
        push = sum_of(self._push(own), self._white(lasting))
        y = self.core.output(t, core, window, self._core_p(p), self._white(w), dt, *given(push))
        readings = {}
        for a in self._filters:
            assert isinstance(a.part, SensorPart)
            reading = a.part.shown(
                own[a.own], driving[a.own], self._values(a, p), self._of_sensor(a, y), dt
            )
            readings[a.place.columns[0]] = reading
        return self._shown(y, readings)

    def innovation(self, y: Expr, y_hat: Expr, x: Expr) -> Expr:
        """That of the core less the sensors' own noise."""
        core, own = self._split(x)
        e = self.core.innovation(y, y_hat, core)
        if not self._errs.nnz():
            return e
        return e - self._errs @ self._turned(core, own, into_world=False)

    def boxplus(self, x: Expr, d: Expr) -> Expr:
        """Core's chart, own states by addition, in body axes."""
        core, own = self._split(x)
        n = len(self.core.error_states)
        return ca.vertcat(self.core.boxplus(core, d[:n]), own + self._turned(core, d[n:]))

    def boxminus(self, x2: Expr, x1: Expr) -> Expr:
        """Core's chart, own states by subtraction, in body axes."""
        (core1, own1), (core2, own2) = self._split(x1), self._split(x2)
        change = self._turned(core1, own2 - own1, into_world=False)
        return ca.vertcat(self.core.boxminus(core2, core1), change)

    # ---------------------------------------------------------------- starts

    def initial_state(self, start: Mapping[str, FloatArray]) -> tuple[FloatArray, FloatArray]:
        """Core's start, then those of the parts: mostly zero, with the spread of typical white
        noise at their place."""
        x0, sigma = self.core.initial_state(start)
        values, spread = [x0], [sigma]
        for part, place, _, _ in self._placed:
            own = part.start(place, part.typical(self.core, place, START_STEP), start)
            values.append(own[0])
            spread.append(own[1])
        return np.concatenate(values), np.concatenate(spread)

    def reference(self, means: Mapping[str, float]) -> FloatArray:
        """Core's reference; no noise, filters show the mean of their sensor."""
        own = [part.settled(place, means) for part, place, _, _ in self._placed]
        return np.concatenate([self.core.reference(means), *own])

    def noise_scale(self, dt: float) -> FloatArray:
        """Core's scales, then those of what drives the parts."""
        own = [
            part.driving(part.typical(self.core, place, dt), dt)
            for part, place, _, _ in self._placed
        ]
        return np.concatenate([self.core.noise_scale(dt), *own])


# -------------------------------------------------------------------- parts of a model


def with_parts(dynamics: Dynamics, parts: Iterable[NoisePart]) -> Dynamics:
    """The model with further noise parts; `dynamics` itself where there are none."""
    chosen = tuple(parts)
    return Augmented(core=dynamics, parts=chosen) if chosen else dynamics


def without_parts(dynamics: Dynamics) -> Dynamics:
    """The model without any noise parts."""
    return dynamics.core if isinstance(dynamics, Augmented) else dynamics


def with_white_sensors(dynamics: Dynamics) -> Dynamics:
    """The model with its disturbances alone: the noise of its sensors is white."""
    if not isinstance(dynamics, Augmented):
        return dynamics
    return with_parts(dynamics.core, [p for p in dynamics.parts if isinstance(p, Disturbance)])


def with_disturbance(dynamics: Dynamics, groups: Iterable[str], *, time: float = 1.0) -> Dynamics:
    """The model with disturbance states of these groups of its process noise, correlation times
    starting at `time` [s].

    Raises `UnknownNameError` for a group that it does not have.
    """
    return with_parts(dynamics, [Disturbance(group=g, time=time) for g in groups])


def sensor_parts(dynamics: Dynamics) -> tuple[SensorPart, ...]:
    """The noise of the sensors of a model, under whatever layers; none where they are white."""
    return tuple(p for p in _parts(dynamics) if isinstance(p, SensorPart))


def disturbances(dynamics: Dynamics) -> tuple[Disturbance, ...]:
    """The disturbances of a model, under whatever layers; none without disturbance states."""
    return tuple(p for p in _parts(dynamics) if isinstance(p, Disturbance))


def sensor_errors(dynamics: Dynamics) -> dict[tuple[str, ...], list[list[str]]]:
    """Columns of a sensor -> names of the states that add to its innovation, components in order,
    for each of its noise parts; of a model under whatever layers."""
    found: dict[tuple[str, ...], list[list[str]]] = {}
    for layer in layers(dynamics):
        for part in layer.parts if isinstance(layer, Augmented) else ():
            if isinstance(part, SensorPart) and not part.filters:
                place = part.place(layer.base)
                own = part.signals(place)[: len(place.rows)]
                found.setdefault(place.readings, []).append([s.name for s in own])
    return found


def noise_states(dynamics: Dynamics) -> frozenset[str]:
    """Names of the states that are noise, of a model under whatever layers."""
    return frozenset(
        s.name
        for layer in layers(dynamics)
        if isinstance(layer, Augmented)
        for s in layer.states.signals[len(layer.core.states) :]
    )


def lasting_errors(dynamics: Dynamics) -> BoolArray:
    """Which error states (n_d,) are noise in its stationary state from the first sample on, of a
    model under whatever layers."""
    names = {
        f"d_{s.name}"
        for layer in layers(dynamics)
        if isinstance(layer, Augmented)
        for part in layer.parts
        if part.lasting
        for s in part.signals(part.place(layer.core))
    }
    return np.array([n in names for n in dynamics.error_states.names], dtype=bool)


def _parts(dynamics: Dynamics) -> list[NoisePart]:
    return [p for layer in layers(dynamics) if isinstance(layer, Augmented) for p in layer.parts]
