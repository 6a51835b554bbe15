"""InnovationForm: any predictor as a state-space model from sample to sample, so that one builder
exports it.

    x+ = F(x, u) [+] K (g(z) + e),    y = H(x, u) + E (g(z) + e),    z = z(x, u),    cov(e) = S

e is the innovation, g the learned part: what it foretells of the innovation moves the state as a
measured one would. x holds what the predictor remembers: the state of a linear or physical model,
past outputs and commands (the lags of its regressors), its last errors. It is a `Dynamics` whose
process noise is e; measured signals that it does not foretell are `exogenous` inputs, run-time
parameters of an export.

| form | F, H | g |
|---|---|---|
| `BaseForm` | a linear model, or a physical one with its stationary filter | GP or none |
| `LagForm` | a shift register; H: the last output for increments | GP (NARX) or LSTM |
| `StaticForm` | no state | a GP alone, of its inputs |
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from greybox.baselines.base_predictor import BasePredictor
from greybox.baselines.predictor_features import column_of, layout_of, uses_errors
from greybox.baselines.regressors import Lags
from greybox.data.channel import channel, is_canonical
from greybox.errors import ModelError
from greybox.model.parameter import Parameter
from greybox.residual import features as model_features
from greybox.symbolic import Expr, FloatArray, Layout, Signal, sum_of
from mpc_export.sampled import Sampled

OFFSET = "offset."


class InnovationForm(ABC):
    """Base of the forms; satisfies `Dynamics`. A form has the abstract members and keeps the
    rest."""

    parameters: tuple[Parameter, ...] = ()
    window = (0, 0)

    @property
    @abstractmethod
    def name(self) -> str:
        """A short name for reports."""

    @property
    @abstractmethod
    def states(self) -> Layout:
        """x, n_x."""

    @property
    @abstractmethod
    def inputs(self) -> Layout:
        """Columns that drive the predictor, `exogenous` ones included."""

    @property
    @abstractmethod
    def outputs(self) -> Layout:
        """y, n_y."""

    @property
    def exogenous(self) -> tuple[str, ...]:
        """Names of the inputs that a controller does not choose."""
        return ()

    @property
    def error_states(self) -> Layout:
        """The states themselves, unless a chart says otherwise."""
        return self.states

    @property
    def innovations(self) -> Layout:
        """One per output."""
        return self.outputs

    @property
    def innovation_columns(self) -> tuple[tuple[str, ...], ...]:
        """Each innovation needs the output of its own name."""
        return tuple((n,) for n in self.outputs.names)

    @property
    def noises(self) -> Layout:
        """The innovations are the process noise."""
        return self.innovations

    @property
    @abstractmethod
    def gain(self) -> FloatArray:
        """K (n_d, n_e)."""

    @property
    def seen(self) -> FloatArray:
        """E (n_y, n_e)."""
        return np.eye(len(self.outputs), len(self.innovations))

    @abstractmethod
    def following(self, x: Expr, u: Expr) -> Expr:
        """F, the state one sample later without innovation."""

    @abstractmethod
    def foretold(self, x: Expr, u: Expr) -> Expr:
        """H, the outputs at the sample without innovation."""

    @abstractmethod
    def features(self, names: Sequence[str], x: Expr, u: Expr) -> Expr:
        """z, by name."""

    def f(self, t: Expr, x: Expr, u: Expr, p: Expr, w: Expr = None) -> Expr:
        """The next state (the model is discrete)."""
        after = self.following(x, u)
        return after if w is None else self.boxplus(after, ca.DM(self.gain) @ w)

    def h(self, t: Expr, x: Expr, u: Expr, p: Expr, w: Expr = None) -> Expr:
        """Outputs."""
        y = self.foretold(x, u)
        return y if w is None else y + ca.sparsify(ca.DM(self.seen)) @ w

    def step(self, t: Expr, x: Expr, window: Expr, p: Expr, w: Expr, dt: Expr) -> Expr:
        """Next state with innovation w."""
        return self.f(t, x, window[:, 0], p, w)

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
        """Outputs with innovation w."""
        return self.h(t, x, window[:, 0], p, sum_of(w, lasting))

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
        """Zero, unknown to 1."""
        return np.zeros(len(self.states)), np.ones(len(self.error_states))

    def reference(self, means: Mapping[str, float]) -> FloatArray:
        """The states that are named in `means`, zero for the others."""
        return np.array([means.get(n, 0.0) for n in self.states.names])

    def noise_scale(self, dt: float) -> FloatArray:
        """One per innovation."""
        return np.ones(len(self.noises))

    def sensor_scale(self) -> FloatArray:
        """The innovation holds the sensor noise: nearly none beside it."""
        return np.full(len(self.innovations), 1e-3)


@dataclass(frozen=True, kw_only=True, eq=False)
class StaticForm(InnovationForm):
    """y = g(u) + e: a learned function alone, without a state."""

    label: str
    arguments: Layout
    results: Layout

    @property
    def name(self) -> str:
        """A short name for reports."""
        return self.label

    @property
    def states(self) -> Layout:
        """x, in order."""
        return Layout([])

    @property
    def inputs(self) -> Layout:
        """Columns that drive it, exogenous ones last."""
        return self.arguments

    @property
    def outputs(self) -> Layout:
        """y, in order."""
        return self.results

    @property
    def gain(self) -> FloatArray:
        """K (n_d, n_e)."""
        return np.zeros((0, len(self.outputs)))

    def following(self, x: Expr, u: Expr) -> Expr:
        """F."""
        return ca.SX(0, 1)

    def foretold(self, x: Expr, u: Expr) -> Expr:
        """H."""
        return ca.SX.zeros(len(self.outputs))

    def features(self, names: Sequence[str], x: Expr, u: Expr) -> Expr:
        """z, by name."""
        return ca.vertcat(*(u[self.inputs[n]] for n in names))


@dataclass(frozen=True, kw_only=True, eq=False)
class LagForm(InnovationForm):
    """The past samples of `lags` as state; with `increments` y starts from the last output."""

    label: str
    lags: Lags
    increments: bool

    @property
    def name(self) -> str:
        """A short name for reports."""
        return self.label

    @cached_property
    def states(self) -> Layout:
        """Past outputs y[t-1] .. y[t-n_a], then past inputs as far back as regressors look."""
        deepest = self.lags.n_b + self.lags.newest - 1
        named = [(n, i) for i in range(1, self.lags.n_a + 1) for n in self.lags.outputs]
        named += [(n, i) for i in range(1, deepest + 1) for n in self.lags.inputs]
        return Layout(
            [Signal(name=f"{n}[t-{i}]", unit=_unit(n), meaning=_ago(n, i)) for n, i in named]
        )

    @cached_property
    def inputs(self) -> Layout:
        """Columns that drive it, exogenous ones last."""
        return Layout([Signal(name=n, unit=_unit(n)) for n in self.lags.inputs])

    @cached_property
    def outputs(self) -> Layout:
        """y, in order."""
        return self.lags.output_layout

    @cached_property
    def gain(self) -> FloatArray:
        """What is measured now is the last output of the next sample."""
        return np.eye(len(self.states), len(self.outputs))

    def following(self, x: Expr, u: Expr) -> Expr:
        """F."""
        n_y, n_u = len(self.outputs), len(self.inputs)
        ends = self.lags.n_a * n_y
        kept = x[: ends - n_y]
        moved = x[ends:]
        pushed = ca.vertcat(u, moved)[: moved.numel()] if n_u else moved
        return ca.vertcat(self.foretold(x, u), kept, pushed)

    def foretold(self, x: Expr, u: Expr) -> Expr:
        """H."""
        n_y = len(self.outputs)
        return x[:n_y] if self.increments else ca.SX.zeros(n_y)

    def features(self, names: Sequence[str], x: Expr, u: Expr) -> Expr:
        """z, by name."""
        table = {n: x[i] for i, n in enumerate(self.states.names)}
        table |= {f"{n}[t]": u[i] for i, n in enumerate(self.inputs.names)}
        return ca.vertcat(*(table[n] for n in names))


@dataclass(frozen=True, kw_only=True, eq=False)
class BaseForm(InnovationForm):
    """An identified model and what a GP on its output residual, if any, remembers and is given
    (`looked_at`)."""

    base: BasePredictor
    looked_at: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """A short name for reports."""
        return str(self.base.model.name)

    @cached_property
    def sampled(self) -> Sampled:
        """The base model with its delayed commands as states."""
        values = dict(self.base.model.values)
        return Sampled(dynamics=self.base.dynamics, dt=self.base.dt, values=values)

    # -------------------- what is where

    @cached_property
    def given(self) -> tuple[str, ...]:
        """Features that are columns of the log which do not drive the model."""
        late = [(n, c) for n in self.looked_at if (c := column_of(n)) is not None]
        return tuple(n for n, (column, _) in late if column not in self._columns)

    @cached_property
    def _columns(self) -> tuple[str, ...]:
        """Commands as columns of the log."""
        return tuple(c for c in self.base.commands if c not in self.sampled.parameters.names)

    @cached_property
    def _offsets(self) -> tuple[str, ...]:
        """Outputs whose offset an adapted model finds anew on every flight."""
        return tuple(f"{OFFSET}{n}" for n in self.base.offsets)

    @cached_property
    def _lagged(self) -> tuple[tuple[str, int], ...]:
        """(command column, lag) of every state that remembers one for the features."""
        deepest: dict[str, int] = {}
        for column, lag in filter(None, map(column_of, self.looked_at)):
            if column in self._columns and lag:
                deepest[column] = max(deepest.get(column, 0), lag)
        return tuple(
            (c, i)
            for i in range(1, max(deepest.values(), default=0) + 1)
            for c in deepest
            if deepest[c] >= i
        )

    @cached_property
    def _errors(self) -> tuple[str, ...]:
        """Outputs whose last one-step error is remembered: all, where one is."""
        return self.base.outputs if uses_errors(self.looked_at) else ()

    def _extra(self, prefix: str) -> list[Signal]:
        units = {s.name: s.unit for s in self.base.dynamics.outputs}
        past = [
            Signal(name=f"{prefix}{c}[t-{i}]", unit=_unit(c), meaning=_ago(c, i))
            for c, i in self._lagged
        ]
        last = [
            Signal(
                name=f"{prefix}error.{n}[t-1]", unit=units[n], meaning=f"last one-step error of {n}"
            )
            for n in self._errors
        ]
        return past + last

    @cached_property
    def states(self) -> Layout:
        """The model's own with its command history, then lags of commands and last errors for the
        features."""
        return self.sampled.states + Layout(self._extra(""))

    @cached_property
    def error_states(self) -> Layout:
        """Of the chart of the model, then the memory."""
        return self.sampled.error_states + Layout(self._extra("d_"))

    @cached_property
    def exogenous(self) -> tuple[str, ...]:
        """Inputs of the model that nobody commands, measured features, offsets."""
        return (*self.sampled.parameters.names, *self.given, *self._offsets)

    @cached_property
    def inputs(self) -> Layout:
        """Command columns, then what is given: exogenous inputs of the model, measured features,
        offsets."""
        units = {s.name: s.unit for s in layout_of(self.base, self.given)}
        units |= {s.name: s.unit for s in self.base.dynamics.outputs}
        units |= {s.name: s.unit for s in (*self.sampled.inputs, *self.sampled.parameters)}
        names = (*self._columns, *self.exogenous)
        return Layout(
            [Signal(name=n, unit=units.get(n.removeprefix(OFFSET), _unit(n))) for n in names]
        )

    @property
    def outputs(self) -> Layout:
        """y, in order."""
        return self.base.dynamics.outputs

    @cached_property
    def innovations(self) -> Layout:
        """Those of the model; of plain outputs under the output's name."""
        own = self.base.dynamics
        return Layout(
            [
                Signal(name=c[0] if len(c) == 1 else s.name, unit=s.unit, meaning=s.meaning)
                for s, c in zip(own.innovations, own.innovation_columns)
            ]
        )

    @property
    def innovation_columns(self) -> tuple[tuple[str, ...], ...]:
        """Those of the model."""
        return tuple(self.base.dynamics.innovation_columns)

    @cached_property
    def gain(self) -> FloatArray:
        """K (n_d, n_e)."""
        own = self.base.gain[0]
        between = np.zeros((len(self.sampled.history) + len(self._lagged), own.shape[1]))
        last = np.eye(own.shape[1])[self.base.rows] if self._errors else np.zeros((0, own.shape[1]))
        return np.vstack([own, between, last])

    @cached_property
    def seen(self) -> FloatArray:
        """E: an innovation reaches the plain output of its name."""
        matrix = np.zeros((len(self.outputs), len(self.innovations)))
        for e, columns in enumerate(self.innovation_columns):
            if len(columns) == 1:
                matrix[self.outputs[columns[0]], e] = 1.0
        return matrix

    # -------------------- the maps

    def _command(self, u: Expr) -> Expr:
        """The model's own commands: sums of columns."""
        table = {n: u[i] for i, n in enumerate(self._columns)}
        rows = []
        for n in self.sampled.inputs.names:
            rows.append(sum(w * table[c] for w, c in self.base.terms(n)))
        return ca.vertcat(*rows) if rows else ca.SX(0, 1)

    def _split(self, x: Expr, u: Expr) -> tuple[Expr, Expr, Expr]:
        """(state, command, exogenous inputs) of the base."""
        first = len(self._columns)
        return (
            x[: len(self.sampled.states)],
            self._command(u),
            u[first : first + len(self.sampled.parameters)],
        )

    def _quiet(self) -> Expr:
        return ca.SX.zeros(len(self.base.dynamics.noises))

    def following(self, x: Expr, u: Expr) -> Expr:
        """F."""
        own, command, p = self._split(x, u)
        after = self.sampled.step(own, command, p, self._quiet())
        at = {pair: own.numel() + k for k, pair in enumerate(self._lagged)}
        past = [u[self.inputs[c]] if i == 1 else x[at[c, i - 1]] for c, i in self._lagged]
        return ca.vertcat(after, *past, ca.SX.zeros(len(self._errors)))

    def foretold(self, x: Expr, u: Expr) -> Expr:
        """H."""
        own, command, p = self._split(x, u)
        y = ca.SX(self.sampled.output(own, command, p, self._quiet()))
        for n in self._offsets:
            y[self.outputs[n.removeprefix(OFFSET)]] += u[self.inputs[n]]
        return y

    def features(self, names: Sequence[str], x: Expr, u: Expr) -> Expr:
        """z, by name."""
        own, command, p = self._split(x, u)
        y = self.foretold(x, u)
        table = {n: x[i] for i, n in enumerate(self.states.names)}
        table |= {n: y[self.outputs[n]] for n in self.base.outputs}
        table |= {f"{n}[t]": u[i] for i, n in enumerate(self._columns)}
        table |= {n: u[self.inputs[n]] for n in self.given}
        there = model_features.available(self.base.dynamics)
        inner = [n for n in names if n in there]
        if inner:
            found = self.sampled.features(inner, own, command, p)
            table |= {n: found[i] for i, n in enumerate(inner)}
        return ca.vertcat(*(table[n] for n in names))

    def innovation(self, y: Expr, y_hat: Expr, x: Expr) -> Expr:
        """As the model forms it."""
        return self.sampled.innovation(y, y_hat, x[: len(self.sampled.states)])

    def boxplus(self, x: Expr, d: Expr) -> Expr:
        """On the chart of the model, by addition elsewhere."""
        n, m = len(self.sampled.states), len(self.sampled.error_states)
        return ca.vertcat(self.sampled.boxplus(x[:n], d[:m]), x[n:, :] + d[m:, :])

    def boxminus(self, x2: Expr, x1: Expr) -> Expr:
        """Inverse of `boxplus`."""
        n = len(self.sampled.states)
        return ca.vertcat(self.sampled.boxminus(x2[:n], x1[:n]), x2[n:, :] - x1[n:, :])

    def check(self) -> None:
        """Raises `ModelError` for what has no form: commands that run linearly between samples."""
        if self.base.dynamics.window[1]:
            raise ModelError(
                f"{self.name}: commands that run linearly between samples",
                expected="commands that are held",
                fix='fit with hold = "zero" in the vehicle file',
            )


@dataclass(frozen=True, kw_only=True, eq=False)
class SampledForm(Sampled):
    """An innovation form as a controller sees it: it says itself what is exogenous and what its
    features are."""

    dynamics: InnovationForm

    @property
    def exogenous(self) -> tuple[str, ...]:
        """Input columns that are run-time parameters here."""
        return self.dynamics.exogenous

    def features(self, names: Sequence[str], x: Expr, u: Expr, p: Expr) -> Expr:
        """Inputs of the learned part, by name."""
        return self.dynamics.features(names, x, self.current(u, p))


def _unit(name: str) -> str:
    return channel(name).unit if is_canonical(name) else "1"


def _ago(name: str, lag: int) -> str:
    return f"{name} {lag} sample{'s' if lag > 1 else ''} before the predicted one"
