"""Disturbed: any Dynamics plus slowly varying disturbances on chosen process-noise channels.

Each disturbance d is a first-order Gauss-Markov process, d+ = exp(-dt/T) d + w_d, and enters where the white noise of its
channel enters; T -> infinity is a random walk. The predictor then carries the disturbance as a state (Kristensen, Madsen
and Jorgensen 2004, Computers & Chemical Engineering 28, sec. 4).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from greybox.errors import ModelError, UnknownNameError
from greybox.model.dynamics import Dynamics
from greybox.model.parameter import Parameter
from greybox.symbolic import Expr, FloatArray, Layout, Signal


@dataclass(frozen=True, kw_only=True)
class Disturbed:
    """`inner` with one disturbance state per process-noise channel whose group is in `groups`.

    A group is the part of a noise name before the dot ("force", "torque"); each group has one time constant parameter
    `disturbance.<group>.T` [s]. Raises `UnknownNameError` for a group that the model does not have.
    """

    inner: Dynamics
    groups: tuple[str, ...]
    time_constant: float = 1.0

    def __post_init__(self) -> None:
        known = {n.split(".")[0] for n in self.inner.noises.names}
        for g in self.groups:
            if g not in known:
                raise UnknownNameError("disturbance group", g, known)
        if not self.groups:
            raise ModelError("no disturbance group", expected=f"some of {', '.join(sorted(known))}")

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name == "inner":
            raise AttributeError(name)
        return getattr(self.inner, name)

    def without_effect(self, *names: str) -> Disturbed:
        """As the inner model's, with the same disturbances."""
        inner: Any = self.inner
        return replace(self, inner=inner.without_effect(*names))

    def with_effect(self, *effects: Any) -> Disturbed:
        """As the inner model's, with the same disturbances."""
        inner: Any = self.inner
        return replace(self, inner=inner.with_effect(*effects))

    @cached_property
    def _rows(self) -> tuple[int, ...]:
        return tuple(i for i, n in enumerate(self.inner.noises.names) if n.split(".")[0] in self.groups)

    @cached_property
    def _spread(self) -> Any:
        e = ca.DM(len(self.inner.noises), len(self._rows))
        for j, i in enumerate(self._rows):
            e[i, j] = 1.0
        return e

    def _signals(self, prefix: str) -> list[Signal]:
        chosen = [self.inner.noises.signals[i] for i in self._rows]
        return [Signal(name=prefix + s.name, unit=s.unit, meaning=f"disturbance, {s.meaning}") for s in chosen]

    @property
    def name(self) -> str:
        """Name of the inner model and the disturbed groups."""
        return f"{self.inner.name}, disturbance {', '.join(self.groups)}"

    @cached_property
    def states(self) -> Layout:
        """Inner states, then disturbance.<noise>."""
        return self.inner.states + Layout(self._signals("disturbance."))

    @cached_property
    def error_states(self) -> Layout:
        """Inner error states, then the disturbances."""
        return self.inner.error_states + Layout(self._signals("d_disturbance."))

    @cached_property
    def noises(self) -> Layout:
        """Inner noises, then the driving noise of each disturbance."""
        return self.inner.noises + Layout(self._signals("disturbance."))

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Inner parameters, then the time constants (log-normal spread by bounds 0.02 .. 100 s)."""
        own = tuple(
            Parameter(
                name=f"disturbance.{g}.T", unit="s", nominal=self.time_constant, lower=0.02, upper=100.0,
                scale=self.time_constant, meaning=f"correlation time of the {g} disturbance",
            )
            for g in self.groups
        )  # fmt: skip
        return (*self.inner.parameters, *own)

    def _parts(self, x: Expr) -> tuple[Expr, Expr]:
        n = len(self.inner.states)
        return x[:n], x[n:]

    def _p(self, p: Expr) -> Expr:
        return p[: len(self.inner.parameters)]

    def _pushed(self, d: Expr, w: Expr) -> Expr:
        n = len(self.inner.noises)
        return self._spread @ d if w is None else w[:n] + self._spread @ d

    def f(self, t: Expr, x: Expr, u: Expr, p: Expr, w: Expr = None) -> Expr:
        """Inner derivative under the disturbance's push, and -d/T."""
        xi, d = self._parts(x)
        return ca.vertcat(self.inner.f(t, xi, u, self._p(p), self._pushed(d, w)), -d / self._times(p))

    def h(self, t: Expr, x: Expr, u: Expr, p: Expr, w: Expr = None) -> Expr:
        """Inner outputs; the disturbance force reaches the accelerometer."""
        xi, d = self._parts(x)
        return self.inner.h(t, xi, u, self._p(p), self._pushed(d, w))

    def _times(self, p: Expr) -> Expr:
        n = len(self.inner.parameters)
        at = {g: n + i for i, g in enumerate(self.groups)}
        return ca.vertcat(*(p[at[self.inner.noises.names[i].split(".")[0]]] for i in self._rows))

    def step(self, t: Expr, x: Expr, window: Expr, p: Expr, w: Expr, dt: Expr) -> Expr:
        """The disturbance is held over the step and added to the white noise of its channel."""
        xi, d = self._parts(x)
        n = len(self.inner.noises)
        after = self.inner.step(t, xi, window, self._p(p), self._pushed(d, w), dt)
        return ca.vertcat(after, ca.exp(-dt / self._times(p)) * d + w[n:])

    def output(self, t: Expr, x: Expr, window: Expr, p: Expr, w: Expr, dt: Expr) -> Expr:
        """Outputs see the disturbance as they see the white noise of its channel."""
        xi, d = self._parts(x)
        return self.inner.output(t, xi, window, self._p(p), self._pushed(d, w), dt)

    def innovation(self, y: Expr, y_hat: Expr, x: Expr) -> Expr:
        """As the inner model."""
        return self.inner.innovation(y, y_hat, self._parts(x)[0])

    def boxplus(self, x: Expr, d: Expr) -> Expr:
        """Inner chart, disturbances by addition."""
        xi, dist = self._parts(x)
        n = len(self.inner.error_states)
        return ca.vertcat(self.inner.boxplus(xi, d[:n]), dist + d[n:])

    def boxminus(self, x2: Expr, x1: Expr) -> Expr:
        """Inner chart, disturbances by subtraction."""
        a, da = self._parts(x1)
        b, db = self._parts(x2)
        return ca.vertcat(self.inner.boxminus(b, a), db - da)

    def reference(self, means: Mapping[str, float]) -> FloatArray:
        """Inner reference, no disturbance."""
        return np.concatenate([self.inner.reference(means), np.zeros(len(self._rows))])

    def initial_state(self, start: Mapping[str, FloatArray]) -> tuple[FloatArray, FloatArray]:
        """Inner start; disturbances start at zero with a spread of a typical process-noise level."""
        x0, sigma = self.inner.initial_state(start)
        scale = self.noise_scale(0.01)[list(self._rows)]
        return np.concatenate([x0, np.zeros(len(self._rows))]), np.concatenate([sigma, scale])

    def noise_scale(self, dt: float) -> FloatArray:
        """Inner scales; the driving noise of a disturbance starts at a tenth of its channel's level."""
        inner = self.inner.noise_scale(dt)
        return np.concatenate([inner, 0.1 * inner[list(self._rows)]])

    def sensor_scale(self) -> FloatArray:
        """As the inner model."""
        return self.inner.sensor_scale()
