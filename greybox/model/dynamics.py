"""Dynamics: the one protocol that linear, physics, user-written and hybrid models share. Estimation
knows only this.

Time is discrete at the seam: `step` carries the state over one sample, `output` is what the sensors
see. Process noise w enters both, because white force noise also reaches the accelerometer
(cross-covariance of process and measurement). States may live on a manifold (a unit quaternion);
`boxplus` and `boxminus` are its chart, the identity for vectors.

Inputs come as a window U, n_u x (past + 1 + future): column j is the command of sample k - past +
j, so that a delay is an interpolation of the record and not a state. A model without delay has past
= future = 0 and U is the column u_k.
"""

from __future__ import annotations

import pickle
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import casadi as ca
import numpy as np

from greybox.errors import ModelError, UnknownNameError
from greybox.model.parameter import Parameter
from greybox.symbolic import Expr, FloatArray, Layout, Signal
from greybox.takes import COUNT, NUMBER, POSITIVE, shown


@runtime_checkable
class Dynamics(Protocol):
    """What estimation, validation and export need to know of a model. Argument order is (t, x, u,
    p) everywhere."""

    @property
    def name(self) -> str:
        """A short name for reports."""

    @property
    def states(self) -> Layout:
        """Raw states x, n_x (a quaternion counts four)."""

    @property
    def error_states(self) -> Layout:
        """Error state, n_d components (a quaternion counts three)."""

    @property
    def inputs(self) -> Layout:
        """Commands u, n_u; the names are columns of the data."""

    @property
    def outputs(self) -> Layout:
        """Measured channels y, n_y; the names are columns of the data."""

    @property
    def innovations(self) -> Layout:
        """Components of the innovation, n_e (a measured quaternion gives three)."""

    @property
    def innovation_columns(self) -> tuple[tuple[str, ...], ...]:
        """Per innovation component the output names that it needs; it is missing where one of them
        is missing."""

    @property
    def noises(self) -> Layout:
        """Process noise w, n_w: each component is constant over a step and white between steps."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Declarations, in the order of the vector p."""

    @property
    def window(self) -> tuple[int, int]:
        """(past, future): how many earlier and later commands a step looks at, in samples."""

    def f(self, t: Expr, x: Expr, u: Expr, p: Expr, w: Expr = None) -> Expr:
        """dx/dt [state unit / s], n_x, at the command u (n_u; a command delay is not part of f).

        w (n_w), where given, pushes through the channels of the process noise. Discrete models give
        the next state.
        """

    def h(self, t: Expr, x: Expr, u: Expr, p: Expr, w: Expr = None) -> Expr:
        """Outputs y, n_y, at the command u, without sensor noise; w has always pushed, as the
        command."""

    def step(self, t: Expr, x: Expr, window: Expr, p: Expr, w: Expr, dt: Expr) -> Expr:
        """State one sample later, n_x, for the command window (n_u x (past + 1 + future)) and
        process noise w."""

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
        """Outputs y at the sample, n_y, given the command window and the process noise w of the
        step that begins.

        `lasting` (n_w), where given, pushes through the same channels, now and before: a late
        sensor goes back under it.
        """

    def innovation(self, y: Expr, y_hat: Expr, x: Expr) -> Expr:
        """Innovation e, n_e, of the measured y against the predicted y_hat at the predicted state
        x."""

    def boxplus(self, x: Expr, d: Expr) -> Expr:
        """State x moved by the error state d."""

    def boxminus(self, x2: Expr, x1: Expr) -> Expr:
        """Error state d with boxplus(x1, d) = x2."""

    def initial_state(self, start: Mapping[str, FloatArray]) -> tuple[FloatArray, FloatArray]:
        """(x0, sigma) from the first samples of each channel (arrays (n,), NaN = missing): start
        value and its spread.

        `sigma` has one standard deviation per error state; it is the prior of the initial state of
        a flight.
        """

    def reference(self, means: Mapping[str, float]) -> FloatArray:
        """State x (n_x) at which a stationary gain is linearised, given the mean of every channel
        of the data."""

    def noise_scale(self, dt: float) -> FloatArray:
        """Start values of the process-noise levels: standard deviation of w per sample of dt
        seconds (n_w)."""

    def sensor_scale(self) -> FloatArray:
        """Start values of the sensor-noise levels, one standard deviation per innovation component
        (n_e)."""


@dataclass(frozen=True)
class Called:
    """A CasADi `function` of (t, x, u, p) as a user's own is written: p by name."""

    function: ca.Function
    names: tuple[str, ...]

    def __call__(self, t: Expr, x: Expr, u: Expr, p: Mapping[str, Expr]) -> Expr:
        """Its value, a vector."""
        out: Expr = self.function(t, x, u, ca.vertcat(*(p[n] for n in self.names)))
        return out


def _has_a_place(function: object) -> bool:
    """Whether another process finds a function of the user's own by its name."""
    try:
        pickle.dumps(function)
    except (pickle.PicklingError, AttributeError, TypeError):
        return False
    return True


@dataclass(frozen=True, kw_only=True)
class StateSpaceModel:
    """A model of the user's own: CasADi f and h with declared parameters, all states plain numbers
    (no manifold).

    `dynamics(t, x, u, p)` and `measurement(t, x, u, p)` are Python functions that take CasADi
    vectors and return the state derivative (n_x) and the outputs (n_y); `p` maps names to scalars.
    With `discrete=True` `dynamics` returns the next state instead. Process noise enters additively
    on the states named in `noise_states` (all, where None). Raises `ModelError` where sizes do not
    fit.
    """

    name: str
    states: Layout
    inputs: Layout
    outputs: Layout
    parameters: tuple[Parameter, ...]
    dynamics: object
    measurement: object
    noise_states: Sequence[str] | None = None
    discrete: bool = False
    initial: Mapping[str, float] | None = None
    initial_sigma: Mapping[str, float] | None = None
    sensor_sigma: Mapping[str, float] | None = None
    substeps: int = 1

    def __post_init__(self) -> None:
        x, u = ca.SX.sym("x", len(self.states)), ca.SX.sym("u", len(self.inputs))
        p = ca.SX.sym("p", len(self.parameters))
        for what, value, size in (
            ("dynamics", self.f(0, x, u, p), len(self.states)),
            ("measurement", self.h(0, x, u, p), len(self.outputs)),
        ):
            if value.numel() != size:
                raise ModelError(
                    f"{self.name}: {what} returns {value.numel()} values", expected=f"{size}"
                )
        felt = ca.vertcat(self.f(0, x, u, p), self.h(0, x, u, p))
        idle = [
            d.name
            for i, d in enumerate(self.parameters)
            if not any(ca.which_depends(felt, p[i], 1, False))
        ]
        if idle:
            raise ModelError(
                f"{self.name}: nothing depends on the parameter {', '.join(idle)}",
                expected="use in dynamics or measurement",
                fix="use it there, or take its declaration out",
            )
        for what, given, known in (
            ("noise_states", self.noise_states, self.states),
            ("initial", self.initial, self.states),
            ("initial_sigma", self.initial_sigma, self.states),
            ("sensor_sigma", self.sensor_sigma, self.outputs),
        ):
            for name in given or ():
                if name not in known:
                    raise UnknownNameError(f"{self.name}: {what}, name", name, known.names)
        self._demand_numbers()

    def _demand_numbers(self) -> None:
        """Raise `ModelError` for starts that are no numbers, spreads that are none, and a step
        without parts."""
        asked = [(f"initial of {n}", v, NUMBER) for n, v in (self.initial or {}).items()]
        for what in ("initial_sigma", "sensor_sigma"):
            spread: Mapping[str, float] = getattr(self, what) or {}
            asked += [(f"{what} of {n}", v, POSITIVE) for n, v in spread.items()]
        for what, value, kind in (*asked, ("substeps", self.substeps, COUNT)):
            if not kind.fits(value):
                raise ModelError(
                    f"{self.name}: {what}",
                    expected=kind.words,
                    got=shown(value),
                    fix="a small one for what is known exactly" if kind is POSITIVE else None,
                )

    def __hash__(self) -> int:
        """Of the declarations that can be hashed: equal models have equal ones."""
        return hash((self.name, self.parameters, self.dynamics, self.measurement))

    def __getstate__(self) -> dict[str, object]:
        """With the equations of functions that another process does not find (lambdas, those
        within a function)."""
        state = dict(vars(self))
        t, sizes = ca.SX.sym("t"), (len(self.states), len(self.inputs), len(self.parameters))
        x, u, p = (ca.SX.sym(n, size) for n, size in zip("xup", sizes, strict=True))
        names = tuple(d.name for d in self.parameters)
        for part, value in (("dynamics", self.f), ("measurement", self.h)):
            if not _has_a_place(state[part]):
                function = ca.Function(part, [t, x, u, p], [value(t, x, u, p)])
                state[part] = Called(function, names)
        return state

    def _named(self, p: Expr) -> dict[str, Expr]:
        return {d.name: p[i] for i, d in enumerate(self.parameters)}

    @property
    def error_states(self) -> Layout:
        """The states themselves: the chart is the identity."""
        return self.states

    @property
    def innovations(self) -> Layout:
        """One component per output: y - y_hat."""
        return self.outputs

    @property
    def innovation_columns(self) -> tuple[tuple[str, ...], ...]:
        """Each innovation component needs the output of its own name."""
        return tuple((n,) for n in self.outputs.names)

    @property
    def noises(self) -> Layout:
        """White noise on the derivative (continuous) or on the next state (discrete) of the noisy
        states."""
        chosen = self.states.names if self.noise_states is None else self.noise_states
        suffix = "" if self.discrete else "/s"
        return Layout(
            [Signal(name=n, unit=self.states.signals[self.states[n]].unit + suffix) for n in chosen]
        )

    @property
    def window(self) -> tuple[int, int]:
        """No delay: the step looks at u_k alone."""
        return (0, 0)

    def _spread(self) -> Expr:
        rows = [self.states[n] for n in self.noises.names]
        spread = ca.DM(len(self.states), len(rows))
        for j, i in enumerate(rows):
            spread[i, j] = 1.0
        return spread

    def f(self, t: Expr, x: Expr, u: Expr, p: Expr, w: Expr = None) -> Expr:
        """dx/dt (or the next state of a discrete model)."""
        d = ca.vertcat(*ca.vertsplit(ca.vcat(_flat(self.dynamics(t, x, u, self._named(p))))))  # type: ignore[operator]
        return d if w is None else d + self._spread() @ w

    def h(self, t: Expr, x: Expr, u: Expr, p: Expr, w: Expr = None) -> Expr:
        """Noise-free outputs, which do not see w."""
        return ca.vertcat(*ca.vertsplit(ca.vcat(_flat(self.measurement(t, x, u, self._named(p))))))  # type: ignore[operator]

    def step(self, t: Expr, x: Expr, window: Expr, p: Expr, w: Expr, dt: Expr) -> Expr:
        """Classical Runge-Kutta 4 with the command held (`substeps` per sample), or the discrete
        map plus w."""
        if self.discrete:
            return self.f(t, x, window, p, w)
        h = dt / self.substeps
        for _ in range(self.substeps):
            k1 = self.f(t, x, window, p, w)
            k2 = self.f(t, x + h / 2 * k1, window, p, w)
            k3 = self.f(t, x + h / 2 * k2, window, p, w)
            k4 = self.f(t, x + h * k3, window, p, w)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return x

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
        """The outputs do not see the process noise of the coming step."""
        return self.h(t, x, window, p)

    def innovation(self, y: Expr, y_hat: Expr, x: Expr) -> Expr:
        """y - y_hat."""
        return y - y_hat

    def boxplus(self, x: Expr, d: Expr) -> Expr:
        """x + d."""
        return x + d

    def boxminus(self, x2: Expr, x1: Expr) -> Expr:
        """x2 - x1."""
        return x2 - x1

    def initial_state(self, start: Mapping[str, FloatArray]) -> tuple[FloatArray, FloatArray]:
        """Declared start values; a state that is measured under its own name starts at its first
        measured value."""
        x0 = np.array([(self.initial or {}).get(n, 0.0) for n in self.states.names])
        sigma = np.array([(self.initial_sigma or {}).get(n, 1.0) for n in self.states.names])
        for i, n in enumerate(self.states.names):
            seen = np.asarray(start.get(n, np.array([])))
            seen = seen[np.isfinite(seen)]
            if seen.size and n not in (self.initial or {}):
                x0[i] = seen[0]
        return x0, sigma

    def reference(self, means: Mapping[str, float]) -> FloatArray:
        """Declared start values; a state that is measured under its own name at its mean."""
        return np.array([means.get(n, (self.initial or {}).get(n, 0.0)) for n in self.states.names])

    def noise_scale(self, dt: float) -> FloatArray:
        """A hundredth of the initial spread, per step (discrete) or per second over a step
        (continuous)."""
        sigma = np.array([(self.initial_sigma or {}).get(n, 1.0) for n in self.noises.names])
        return 0.01 * sigma / (1.0 if self.discrete else dt)

    def sensor_scale(self) -> FloatArray:
        """`sensor_sigma` where declared, else a tenth of the spread of a state of the same name,
        else 0.1."""
        spread = self.initial_sigma or {}
        return np.array(
            [(self.sensor_sigma or {}).get(n, 0.1 * spread.get(n, 1.0)) for n in self.outputs.names]
        )


def _flat(value: object) -> list[Expr]:
    if isinstance(value, (list, tuple)):
        return list(value)
    return [value]
