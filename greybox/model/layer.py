"""Layer: a Dynamics that adds something to another one, written out member by member; and what lies
under layers.

Noise that is correlated in time (`greybox.model.noise.Augmented`) and learned parts
(`greybox.residual.hybrid`) are layers. A layer overrides the members that it changes; all others
are those of its `base`. Whoever needs the plain model under the layers, its vehicle, sensors or
effects, asks `innermost` or `physics_of`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self, TypeVar

from greybox.errors import GreyboxError, ModelError
from greybox.model.dynamics import Dynamics
from greybox.model.dynamics_text import dynamics_text, parameter_rows
from greybox.model.effect import Effect
from greybox.model.model import PhysicsModel
from greybox.model.parameter import Parameter
from greybox.shown import Cell, Shown
from greybox.symbolic import Expr, FloatArray, Layout, given

D = TypeVar("D", bound=Dynamics)
E = TypeVar("E", bound=GreyboxError)


class Layer(Shown, ABC):
    """Base of every Dynamics that adds something to another one, its `base`. Satisfies
    `Dynamics`."""

    @property
    @abstractmethod
    def base(self) -> Dynamics:
        """The Dynamics that this layer adds to."""

    @abstractmethod
    def on(self, base: Dynamics) -> Self:
        """The same layer on another Dynamics."""

    def _shown_text(self) -> str:
        """Name, what goes in, what comes out and what is unknown."""
        return dynamics_text(self)

    def _shown_rows(self) -> list[dict[str, Cell]]:
        """One row per parameter."""
        return parameter_rows(self)

    def with_effect(self, *effects: str | Effect) -> Self:
        """The same layers on the physics model with further effects. Raises `ModelError` where
        there is no physics model."""
        return with_physics(self, lambda physics: physics.with_effect(*effects))

    def without_effect(self, *names: str) -> Self:
        """The same layers on the physics model without these effects. Raises `ModelError` as
        `with_effect`."""
        return with_physics(self, lambda physics: physics.without_effect(*names))

    # ---------------------------------------------------------------- layouts

    @property
    def name(self) -> str:
        """Name of the base."""
        return self.base.name

    @property
    def states(self) -> Layout:
        """States of the base."""
        return self.base.states

    @property
    def error_states(self) -> Layout:
        """Error states of the base."""
        return self.base.error_states

    @property
    def inputs(self) -> Layout:
        """Commands of the base."""
        return self.base.inputs

    @property
    def outputs(self) -> Layout:
        """Outputs of the base."""
        return self.base.outputs

    @property
    def innovations(self) -> Layout:
        """Innovation components of the base."""
        return self.base.innovations

    @property
    def innovation_columns(self) -> tuple[tuple[str, ...], ...]:
        """Outputs that every innovation component of the base needs."""
        return self.base.innovation_columns

    @property
    def noises(self) -> Layout:
        """Process noises of the base."""
        return self.base.noises

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters of the base."""
        return self.base.parameters

    @property
    def window(self) -> tuple[int, int]:
        """(past, future) commands that a step of the base looks at."""
        return self.base.window

    # ---------------------------------------------------------------- motion

    def f(self, t: Expr, x: Expr, u: Expr, p: Expr, w: Expr = None) -> Expr:
        """dx/dt of the base."""
        return self.base.f(t, x, u, p, w)

    def h(self, t: Expr, x: Expr, u: Expr, p: Expr, w: Expr = None) -> Expr:
        """Outputs of the base without sensor noise."""
        return self.base.h(t, x, u, p, w)

    def step(self, t: Expr, x: Expr, window: Expr, p: Expr, w: Expr, dt: Expr) -> Expr:
        """State of the base one sample later."""
        return self.base.step(t, x, own_window(self.base, window), p, w, dt)

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
        """Outputs of the base at the sample."""
        return self.base.output(t, x, own_window(self.base, window), p, w, dt, *given(lasting))

    def innovation(self, y: Expr, y_hat: Expr, x: Expr) -> Expr:
        """Innovation of the base."""
        return self.base.innovation(y, y_hat, x)

    def boxplus(self, x: Expr, d: Expr) -> Expr:
        """Chart of the base."""
        return self.base.boxplus(x, d)

    def boxminus(self, x2: Expr, x1: Expr) -> Expr:
        """Chart of the base."""
        return self.base.boxminus(x2, x1)

    # ---------------------------------------------------------------- starts

    def initial_state(self, start: Mapping[str, FloatArray]) -> tuple[FloatArray, FloatArray]:
        """Start of a flight of the base."""
        return self.base.initial_state(start)

    def reference(self, means: Mapping[str, float]) -> FloatArray:
        """State at which the base is linearised."""
        return self.base.reference(means)

    def noise_scale(self, dt: float) -> FloatArray:
        """Start values of the process-noise levels of the base."""
        return self.base.noise_scale(dt)

    def sensor_scale(self) -> FloatArray:
        """Start values of the sensor-noise levels of the base."""
        return self.base.sensor_scale()


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class LongerWindow(Layer):
    """`inner` with a command window that reaches at least `past` samples back, for who looks at
    them."""

    inner: Dynamics
    past: int

    @property
    def base(self) -> Dynamics:
        """The same model with its own window."""
        return self.inner

    def on(self, base: Dynamics) -> LongerWindow:
        """The same window on another model."""
        return replace(self, inner=base)

    @property
    def window(self) -> tuple[int, int]:
        """(past, future) commands of a sample."""
        return max(self.past, self.inner.window[0]), self.inner.window[1]


def own_window(dynamics: Dynamics, window: Expr) -> Expr:
    """The command window of `dynamics` out of one that reaches further back."""
    return window[:, window.shape[1] - 1 - sum(dynamics.window) :]


class LearnedErrors(ABC):
    """The error of a learned push at m places."""

    @abstractmethod
    def together(self, others: Sequence[Self], *, open_only: bool = False) -> FloatArray:
        """Covariance (r, m, n_out) with the errors of each of r `others` at its m places, one with
        one.

        open_only: of what no weight can say, as between the support points of a process, alone.
        """


class LearnedPush(Layer):
    """A layer that adds a learned push to some process-noise channels, and says how sure of it it
    is."""

    @property
    @abstractmethod
    def learned_rows(self) -> tuple[int, ...]:
        """Place of every learned output in the process noise w of the base."""

    @abstractmethod
    def learned_errors(self, states: FloatArray, windows: FloatArray) -> LearnedErrors:
        """Error of the learned push at states (m, n_x) with command windows (m, n_u k), a column of
        the window after the other."""


def layers(dynamics: Dynamics) -> Iterator[Layer]:
    """The layers of a model from the outermost inwards; none of a plain model."""
    while isinstance(dynamics, Layer):
        yield dynamics
        dynamics = dynamics.base


def innermost(dynamics: Dynamics) -> Dynamics:
    """The plain model under all layers; the model itself where it has none."""
    while isinstance(dynamics, Layer):
        dynamics = dynamics.base
    return dynamics


def own_parameters(dynamics: Dynamics) -> frozenset[str]:
    """Names of the parameters of the plain model under all layers; all others say how long a noise
    lasts."""
    return frozenset(d.name for d in innermost(dynamics).parameters)


def physics_of(dynamics: Dynamics) -> PhysicsModel | None:
    """The physics model under all layers; None for a model of another kind (linear, written by the
    user)."""
    core = innermost(dynamics)
    return core if isinstance(core, PhysicsModel) else None


def learned_push_of(dynamics: Dynamics) -> LearnedPush | None:
    """The outermost learned part of a model; None where nothing was learned."""
    return next((layer for layer in layers(dynamics) if isinstance(layer, LearnedPush)), None)


def learned_part(kind: type[E], where: str) -> E:
    """What is raised where the physics alone can be taken, and a model with a learned part came."""
    return kind(
        "a model with a learned part",
        where=where,
        expected="the physics alone",
        fix="name the model file that it was learned for; greybox.load reads both",
    )


def with_physics(dynamics: D, change: Callable[[PhysicsModel], PhysicsModel]) -> D:
    """The same layers on a changed physics model. Raises `ModelError` where there is no physics
    model under them."""
    core = innermost(dynamics)
    if not isinstance(core, PhysicsModel):
        raise ModelError(f"{core.name} is not a physics model: it has no effects and no vehicle")
    return with_core(dynamics, change(core))


def with_core(dynamics: D, core: Dynamics) -> D:
    """The same layers on another model."""
    if isinstance(dynamics, Layer):
        return dynamics.on(with_core(dynamics.base, core))
    return core  # type: ignore[return-value]  # a model for a model
