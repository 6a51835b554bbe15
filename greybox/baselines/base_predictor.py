"""BasePredictor: an identified model, linear or physical, as a predictor of measured channels in
innovation form.

    x(t+1|t) = f(x(t|t-1), u) (+) K e(t),    y(t) = h(x(t|t-1), u) + e(t),    cov(e) = S

x(t|t-1) is known without any measurement of time t. A linear model brings K and S, a physical one
those of its stationary filter (Ljung 1999, System Identification, sec. 4.3). With a Gaussian
process g(z) for the mean of e(t) the same recursion runs the output residual of
`greybox.baselines.output_residual`: what g foretells moves the state as a measured e would.

Ahead of an origin the covariance of the state is that of the innovations still to come, and the
GP's own error, which is the same function all along, is carried as a consider state (Schmidt 1966),
both linearised along the predicted path.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import casadi as ca
import numpy as np
import numpy.typing as npt

from greybox.baselines.decoupled import Terms, free_entries
from greybox.data import Flight, Segment
from greybox.data.channel import channel, is_canonical
from greybox.data.segment import START_SECONDS
from greybox.errors import DataError, ModelError, UnknownNameError
from greybox.estimation.filtering import Filter
from greybox.estimation.record import hold_missing
from greybox.frames import numeric
from greybox.linear.prediction import adapt
from greybox.linear.predictor import predict
from greybox.linear.records import Record, delayed
from greybox.model.dynamics import Dynamics
from greybox.model.identified import IdentifiedModel
from greybox.model.linear import LinearModel
from greybox.residual import features as model_features
from greybox.residual.weight_space import Candidate
from greybox.symbolic import BoolArray, Expr, FloatArray, IntArray, Layout, Signal, evaluate
from greybox.validation.adapt import adapt_to_flight

Base = LinearModel | IdentifiedModel
IMU = ("p", "q", "r", "ax", "ay", "az")
RUN_IN = 2.0
"""Seconds after which a linear model that starts from zero is taken to have forgotten that."""
ANGLES = ("phi", "theta", "psi")
QUATERNION = ("qw", "qx", "qy", "qz")
CHUNK = 2000
"""Origins that are rolled out at once (bounds the memory)."""
LATE = re.compile(r"(?P<name>.+)\[t(-(?P<lag>[1-9]\d*))?\]")
LAST_ERROR = re.compile(r"error\.(?P<name>.+)\[t-1\]")


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """One segment under the predictor: `states` (n, n_x) x(t|t-1), `mean` (n, n_o) y(t|t-1),
    `known` (n,) where both are predictions, `inputs` (n + past + future, n_u), parameters p (a zero
    for a linear model), shift (n_o,) of the outputs."""

    states: FloatArray
    mean: FloatArray
    known: BoolArray
    inputs: FloatArray
    p: FloatArray
    shift: FloatArray


@dataclass(frozen=True, kw_only=True, eq=False)
class BasePredictor:
    """Predicts `outputs` of `model` (default: the IMU channels among its outputs, else all that are
    plain numbers).

    `channels`: input of a linear model -> (weight, log column) of the sum that it is; by its own
    name where absent. `adapt` [s]: start, and output offset (linear) or per-flight parameters
    (physical, except of training flights), are fitted on the first seconds of every segment, where
    nothing is then predicted. Raises `UnknownNameError`.
    """

    model: Base
    outputs: tuple[str, ...] = ()
    channels: Mapping[str, Terms] = field(default_factory=dict)
    adapt: float | None = None
    train_seconds: float = 0.0

    def __post_init__(self) -> None:
        plain = [c[0] for c in self.dynamics.innovation_columns if len(c) == 1]
        chosen = self.outputs or tuple(n for n in plain if n in IMU) or tuple(plain)
        for n in chosen:
            if n not in plain:
                raise UnknownNameError("output", n, plain, where=self.dynamics.name)
        object.__setattr__(self, "outputs", tuple(chosen))

    # ----------------------------------------------------------------------------------- the model

    @property
    def dynamics(self) -> Dynamics:
        """The model's equations."""
        return self.model.dynamics

    @property
    def dt(self) -> float:
        """Sample time [s]."""
        return self.model.sample_time

    @cached_property
    def filter(self) -> Filter:
        """The stationary filter of a physical model."""
        assert isinstance(self.model, IdentifiedModel)
        return Filter(self.model)

    @cached_property
    def gain(self) -> tuple[FloatArray, FloatArray]:
        """(K (n_d, n_e), S (n_e, n_e)) with all channels measured."""
        if isinstance(self.model, LinearModel):
            return self.model.matrices[4], self.model.noise
        k, s, _, _ = self.filter.riccati.gain(np.ones(len(self.dynamics.innovations)))
        return k, s

    @property
    def rows(self) -> list[int]:
        """Places of the outputs among the innovations."""
        columns = list(self.dynamics.innovation_columns)
        return [columns.index((n,)) for n in self.outputs]

    @property
    def parameters(self) -> int:
        """How many numbers were fitted: entries of a minimal form, or shared parameters and their
        values per flight."""
        if isinstance(self.model, LinearModel):
            return free_entries(self.model)
        return len(self.model.covariance_names) + sum(
            len(v) for v in self.model.per_flight.values()
        )

    @property
    def commands(self) -> tuple[str, ...]:
        """Log columns that drive the model."""
        if isinstance(self.model, IdentifiedModel):
            return tuple(self.dynamics.inputs.names)
        return tuple(
            dict.fromkeys(c for n in self.dynamics.inputs.names for _, c in self._terms(n))
        )

    def _terms(self, name: str) -> Terms:
        return self.channels.get(name, ((1.0, name),))

    # ------------------------------------------------------------------------------ one step ahead

    def run(self, segment: Segment) -> Run:
        """Predictions of a whole segment. Raises `DataError` (a column is absent, too short),
        `FitError`."""
        if abs(segment.dt - self.dt) > 1e-6 * self.dt:
            raise DataError(
                f"sampled every {segment.dt:g} s, the model every {self.dt:g} s",
                where=f"flight {segment.flight}",
                fix=f"read the log with --rate {1 / self.dt:g}",
            )
        return (
            self._run_linear(segment)
            if isinstance(self.model, LinearModel)
            else self._run_filter(segment)
        )

    def _run_linear(self, segment: Segment) -> Run:
        model = self.model
        assert isinstance(model, LinearModel)
        parts = [[w * segment.column(c) for w, c in self._terms(n)] for n in model.inputs.names]
        u = (
            np.column_stack([np.sum(p, axis=0) for p in parts])
            if parts
            else np.zeros((segment.n, 0))
        )
        u, _ = hold_missing(u)
        if not np.isfinite(u).all():
            raise DataError("an input column has no values", where=f"flight {segment.flight}")
        record = Record(u=u, y=segment.matrix(model.outputs.names), name=segment.flight)
        x0, offset, blind = np.zeros(model.order), model.output_offset, 0
        cut = max(model.delays, default=0)
        if self.adapt is not None:
            # The record begins where its delayed commands are known, and ends with the seconds to
            # adapt on.
            found = adapt(model, record, self.adapt - cut * model.dt)
            x0, offset, blind = found.x0, found.offset, found.samples
        moved = delayed(record, model.delays)
        moved = Record(u=moved.u - model.input_offset, y=moved.y - offset, name=record.name)
        x = predict(model.matrices, moved, x0, np.zeros(len(offset)), model.noise).x
        _, _, c, d, _ = model.matrices
        states, mean = (
            np.full((segment.n, model.order), np.nan),
            np.full((segment.n, len(offset)), np.nan),
        )
        states[cut:], mean[cut:] = x, x @ c.T + moved.u @ d.T + offset
        known = np.arange(segment.n) >= max(cut + 1, blind + cut)
        at = [model.outputs[n] for n in self.outputs]
        return Run(
            states=states,
            mean=mean[:, at],
            known=known,
            inputs=np.vstack([np.repeat(u[:1], cut, axis=0), u]),
            p=np.zeros(1),
            shift=(offset - model.output_offset)[at],
        )

    def _run_filter(self, segment: Segment) -> Run:
        model = self.model
        assert isinstance(model, IdentifiedModel)
        p, x0, sigma, blind = None, None, None, max(3, round(START_SECONDS / segment.dt))
        if self.adapt is not None and segment.flight not in model.trained_on:
            flight = Flight(name=segment.flight, segments=(segment,))
            found = adapt_to_flight(model, flight, self.adapt, riccati=self.filter.riccati)
            p, x0, sigma = model.parameter_vector(found.values), found.x0, found.x0_sigma
            blind = round(self.adapt / segment.dt)
        filtered = self.filter.run(segment, p=p, x0=x0, x0_sigma=sigma)
        at = [self.dynamics.outputs[n] for n in self.outputs]
        return Run(
            states=filtered.states[: segment.n],
            mean=filtered.outputs[:, at],
            known=np.arange(segment.n) >= blind,
            inputs=filtered.record.inputs,
            p=filtered.p,
            shift=np.zeros(len(at)),
        )

    def one_step(self, segment: Segment) -> tuple[FloatArray, FloatArray]:
        """Mean and variance (n, n_o) of every sample from what is known before it; NaN where too
        little is."""
        run = self.run(segment)
        mean = np.where(run.known[:, None], run.mean, np.nan)
        variance = np.broadcast_to(np.diag(self.gain[1])[self.rows], mean.shape)
        return mean, np.where(np.isfinite(mean), variance, np.nan)

    def free_run(
        self, segment: Segment, origins: npt.ArrayLike, horizon: int
    ) -> tuple[FloatArray, FloatArray]:
        """Mean and variance (m, horizon, n_o) of the samples k+1 .. k+horizon from every origin
        k."""
        return self.rolled(segment, origins, horizon, None)

    # ------------------------------------------------------------------------------------ features

    def feature_layout(self, names: Sequence[str]) -> Layout:
        """Units of features: `NAME[t-1]`, `NAME[t-2]`, ... a log column or phi, theta, psi so many
        samples before, `NAME[t]` a command at t, `error.NAME[t-1]` the model's own last one-step
        error, anything else a predicted output or a signal of the predicted state.

        Raises `UnknownNameError`, and `ModelError` for a measurement of time t.
        """
        return Layout([Signal(name=n, unit=self._unit(n)) for n in names])

    def _unit(self, name: str) -> str:
        last = LAST_ERROR.fullmatch(name)
        if last:
            return self.dynamics.outputs.signals[
                self.dynamics.outputs[self.outputs[self._error(name)]]
            ].unit
        late = LATE.fullmatch(name)
        if late:
            if late["lag"] is None and late["name"] not in self.commands:
                raise ModelError(
                    f"feature {name} is a measurement of the predicted instant",
                    expected="a command, or [t-1]",
                )
            column = late["name"]
            return (
                "rad" if column in ANGLES else channel(column).unit if is_canonical(column) else "1"
            )
        own = self._signals()
        if name not in own:
            raise UnknownNameError("feature", name, [*own, *(f"{c}[t-1]" for c in self.commands)])
        return own[name]

    def _error(self, name: str) -> int:
        """Which output a feature `error.NAME[t-1]` belongs to."""
        found = LAST_ERROR.fullmatch(name)
        assert found is not None
        if found["name"] not in self.outputs:
            raise UnknownNameError("feature", name, [f"error.{n}[t-1]" for n in self.outputs])
        return self.outputs.index(found["name"])

    def _signals(self) -> dict[str, str]:
        outputs = {s.name: s.unit for s in self.dynamics.outputs if s.name in self.outputs}
        if isinstance(self.model, LinearModel):
            return {s.name: s.unit for s in self.dynamics.states} | outputs
        there = model_features.available(self.dynamics)
        return outputs | {n: u for n, u in there.items() if n not in self.dynamics.inputs.names}

    def given(self, segment: Segment, names: Sequence[str]) -> FloatArray:
        """The features (n, n_given) that name a sample (`NAME[t-1]`, `NAME[t]`) in their order, the
        last value where one is missing."""
        out = []
        for name in names:
            late = _column(name)
            if late is None:
                continue
            column = late["name"]
            if column in ANGLES and column not in segment.channels:
                value = numeric("euler", hold_missing(segment.matrix(QUATERNION))[0])[
                    :, ANGLES.index(column)
                ]
            else:
                value = hold_missing(segment.column(column)[:, None])[0][:, 0]
            lag = min(int(late["lag"] or 0), segment.n)
            out.append(np.concatenate([np.full(lag, np.nan), value[: segment.n - lag]]))
        return np.column_stack(out) if out else np.zeros((segment.n, 0))

    def errors(self, segment: Segment, run: Run) -> FloatArray:
        """One-step errors (n, n_o) of the sample before each, the last known one where it was not
        measured; NaN before the first."""
        e = np.where(run.known[:, None], segment.matrix(self.outputs) - run.mean, np.nan)
        held, _ = hold_missing(e)
        held[~np.logical_or.accumulate(np.isfinite(e), axis=0)] = np.nan
        return np.vstack([np.full((1, e.shape[1]), np.nan), held[:-1]])

    def features(self, segment: Segment, run: Run, names: Sequence[str]) -> FloatArray:
        """Features (n, n_z) of every sample of a run; NaN where one is not known."""
        width = sum(self._width)
        windows = np.stack([run.inputs[k : k + segment.n] for k in range(width)], axis=1).reshape(
            segment.n, -1
        )
        states = np.where(run.known[:, None], run.states, 0.0)
        z = evaluate(
            self._told(tuple(names), None),
            states,
            windows,
            self.given(segment, names),
            self.errors(segment, run),
            run.p,
            run.shift,
        )
        return np.where(run.known[:, None], z, np.nan)

    @property
    def _n_p(self) -> int:
        # The many entries of linear matrices are constants of the functions; the one argument left
        # is not used.
        return 1 if isinstance(self.model, LinearModel) else len(self.dynamics.parameters)

    @property
    def _width(self) -> tuple[int, int, int]:
        past, future = self.dynamics.window
        return past, 1, future

    def _told(self, names: tuple[str, ...], posterior: Candidate | None) -> ca.Function:
        """(x, window, given, last errors, p, shift) -> z; with `posterior` or no names what a step
        of `rolled` needs."""
        cache = self.__dict__.setdefault("_functions", {})
        key = (names, id(posterior), bool(names) and posterior is None)
        if key not in cache:
            cache[key] = (self._build(names, posterior), posterior)
        return cache[key][0]

    def _build(self, names: tuple[str, ...], posterior: Candidate | None) -> ca.Function:
        d, n_o = self.dynamics, len(self.outputs)
        n_x, n_d = len(d.states), len(d.error_states)
        plain = self._plain([n for n in names if not LATE.fullmatch(n)])
        plus, minus = self._charts()
        state = ca.MX.sym("x", n_x)
        flat = ca.MX.sym("U", len(d.inputs) * sum(self._width))
        given = ca.MX.sym("given", sum(_column(n) is not None for n in names))
        values, shift = ca.MX.sym("p", self._n_p), ca.MX.sym("shift", n_o)
        columns = ca.reshape(flat, len(d.inputs), sum(self._width))
        last, uses = ca.MX.sym("last", n_o), _uses_errors(names)
        # The last errors, where the GP looks at them, are part of the state.
        error, reference = ca.MX.sym("d", n_d + n_o * uses), ca.MX.sym("reference", n_x)
        mean, told, following = plain(plus(state, error[:n_d]), columns, values)
        mean = mean + shift
        z = self._joined(names, told, shift, given, last + error[n_d:] if uses else last)
        arguments = [state, flat, given, last, values, shift]
        still = ca.DM.zeros(error.numel())
        if names and posterior is None:
            return ca.Function("features", arguments, [ca.densify(ca.substitute(z, error, still))])
        push, spread = ca.MX.zeros(n_o), ca.MX.zeros(n_o)
        if posterior is not None:
            both = posterior.expressions(z, ("mean", "variance"))
            push, spread = both["mean"], both["variance"]
        following = plus(following, self.gain[0][:, self.rows] @ push)
        mean = mean + push
        away = minus(following, reference)
        moved_on = ca.vertcat(away, push) if uses else away
        around = ca.Function(
            "around",
            [error, reference, *arguments],
            [mean, spread, push, following, ca.jacobian(mean, error), ca.jacobian(moved_on, error)],
        )
        at = around(still, state, *arguments)[3]
        out = around(still, at, *arguments)
        return ca.Function("step", arguments, [ca.densify(ca.vertcat(*(ca.vec(v) for v in out)))])

    def _plain(self, own: Sequence[str]) -> ca.Function:
        """(x, window, p) -> outputs, the features `own` that need nothing else, next state."""
        d = self.dynamics
        x, p = ca.SX.sym("x", len(d.states)), ca.SX.sym("p", self._n_p)
        numbers = (
            ca.DM([q.nominal for q in d.parameters]) if isinstance(self.model, LinearModel) else p
        )
        window = ca.SX.sym("U", len(d.inputs), sum(self._width))
        quiet = ca.DM.zeros(len(d.noises))
        y = d.output(0, x, window, numbers, quiet, self.dt)[[d.outputs[n] for n in self.outputs]]
        table = {n: y[i] for i, n in enumerate(self.outputs)}
        if isinstance(self.model, LinearModel):
            table |= {n: x[i] for i, n in enumerate(d.states.names)}
        else:
            inner = [n for n in own if n in model_features.available(d)]
            found = model_features.features(d, inner, x, window) if inner else ca.SX(0, 1)
            table |= {n: found[i] for i, n in enumerate(inner)}
        after = d.step(0, x, window, numbers, quiet, self.dt)
        seen = ca.vertcat(*(table[n] for n in own)) if own else ca.SX(0, 1)
        return ca.Function("plain", [x, window, p], [y, seen, after])

    def _charts(self) -> tuple[ca.Function, ca.Function]:
        """(x, d) -> x boxplus d, and (x2, x) -> x2 boxminus x."""
        d = self.dynamics
        x, other = ca.SX.sym("x", len(d.states)), ca.SX.sym("x2", len(d.states))
        step = ca.SX.sym("d", len(d.error_states))
        plus = ca.Function("plus", [x, step], [d.boxplus(x, step)])
        return plus, ca.Function("minus", [other, x], [d.boxminus(other, x)])

    def _joined(
        self, names: Sequence[str], told: Expr, shift: Expr, given: Expr, last: Expr
    ) -> Expr:
        """The features z (n_z,) in their order: the last errors, columns of the log `given`, and
        what the model has `told`."""
        parts, i, j = [], 0, 0
        for n in names:
            if LAST_ERROR.fullmatch(n):
                parts.append(last[self._error(n)])
            elif LATE.fullmatch(n):
                parts.append(given[j])
                j += 1
            else:
                moved = isinstance(self.model, LinearModel) and n in self.outputs
                parts.append(told[i] + shift[self.outputs.index(n)] if moved else told[i])
                i += 1
        return ca.vertcat(*parts) if parts else ca.MX(0, 1)

    # ---------------------------------------------------------------------------------- many steps

    def rolled(
        self, segment: Segment, origins: npt.ArrayLike, horizon: int, posterior: Candidate | None
    ) -> tuple[FloatArray, FloatArray]:
        """Mean and variance (m, horizon, n_o) from origins k, with the GP `posterior` as mean of
        the innovations or None.

        Measured features keep their value at k; of the errors to come the GP's mean is expected.
        NaN where nothing is known at k+1, and past the end.
        """
        k = np.asarray(origins, dtype=np.int64).ravel()
        if k.size and (k.min() < 0 or k.max() >= segment.n):
            raise DataError("an origin lies outside the segment", expected=f"0 .. {segment.n - 1}")
        run = self.run(segment)
        names = () if posterior is None else posterior.inputs.names
        given = self.given(segment, names)
        held = np.array(
            [m["name"] not in self.commands for n in names if (m := _column(n))], dtype=bool
        )
        errors = self.errors(segment, run) if _uses_errors(names) else np.zeros(run.mean.shape)
        mean, variance = np.full((2, len(k), horizon, len(self.outputs)), np.nan)
        for at in range(0, len(k), CHUNK):
            part = slice(at, at + CHUNK)
            mean[part], variance[part] = self._roll(
                run, given, held, errors, k[part], horizon, posterior
            )
        return mean, variance

    def _roll(
        self,
        run: Run,
        given: FloatArray,
        held: BoolArray,
        errors: FloatArray,
        k: IntArray,
        horizon: int,
        posterior: Candidate | None,
    ) -> tuple[FloatArray, FloatArray]:
        told = self._told(() if posterior is None else tuple(posterior.inputs.names), posterior)
        gain, cov = self._driven_by(posterior)
        rows, n, n_o, n_d = self.rows, len(run.mean), len(self.outputs), len(gain)
        fresh = gain @ cov @ gain.T
        own = np.diag(cov)[rows]
        mean, variance = np.full((2, len(k), horizon, n_o), np.nan)
        start = np.minimum(k + 1, n - 1)
        known = np.isfinite(np.hstack([given, errors])[start]).all(axis=1)
        live = np.flatnonzero((k + 1 < n) & run.known[start] & known)
        x, last = run.states[start[live]], errors[start[live]]
        white, learned = np.zeros((len(live), n_d, n_d)), np.zeros((len(live), n_d, n_o))
        width = sum(self._width)
        for h in range(1, horizon + 1):
            row = k[live] + h
            keep = row < n
            live, row, x, last = live[keep], row[keep], x[keep], last[keep]
            white, learned = white[keep], learned[keep]
            if not live.size:
                break
            z = np.where(held, given[k[live] + 1], given[row])
            windows = run.inputs[row[:, None] + np.arange(width)].reshape(len(row), -1)
            step = _Step.of(
                evaluate(told, x, windows, z, last, run.p, run.shift), n_o, x.shape[1], n_d
            )
            mean[live, h - 1], x, last = step.mean, step.x, step.last
            now = step.c @ learned
            now[:, range(n_o), range(n_o)] += step.sd
            variance[live, h - 1] = (
                np.einsum("mij,mjk,mik->mi", step.c, white, step.c) + own + np.sum(now**2, axis=2)
            )
            white = step.a @ white @ step.a.swapaxes(1, 2) + fresh
            learned = step.a @ learned + gain[:, rows] * step.sd[:, None, :]
        return mean, variance

    def _driven_by(self, posterior: Candidate | None) -> tuple[FloatArray, FloatArray]:
        """(gain, covariance) of the innovations that drive the state, which has the last errors in
        it where `posterior` looks at them."""
        gain, cov = self.gain
        if posterior is None:
            return gain, cov
        # The noise of the GP is what is left of the innovations that it foretells.
        scale = np.ones(len(cov))
        scale[self.rows] = np.sqrt(posterior.noise / np.diag(cov)[self.rows])
        cov = cov * scale * scale[:, None]
        if _uses_errors(posterior.inputs.names):
            gain = np.vstack([gain, np.eye(len(cov))[self.rows]])
        return gain, cov


@dataclass(frozen=True, kw_only=True, eq=False)
class _Step:
    """One step of m paths: `mean` (m, n_o), standard deviation `sd` (m, n_o) of the GP, the errors
    `last` (m, n_o) that it expects, next state x (m, n_x), slopes c (m, n_o, n_d) of the mean and a
    (m, n_d, n_d) of the next state."""

    mean: FloatArray
    sd: FloatArray
    last: FloatArray
    x: FloatArray
    c: FloatArray
    a: FloatArray

    @classmethod
    def of(cls, out: FloatArray, n_o: int, n_x: int, n_d: int) -> _Step:
        """Of the rows `out` of the function "step"."""
        mean, spread, last, x, c, a = np.split(
            out, np.cumsum([n_o, n_o, n_o, n_x, n_o * n_d]), axis=1
        )
        return cls(
            mean=mean,
            sd=np.sqrt(np.maximum(spread, 0.0)),
            last=last.copy(),
            x=x.copy(),
            c=c.reshape(-1, n_d, n_o).swapaxes(1, 2),
            a=a.reshape(-1, n_d, n_d).swapaxes(1, 2),
        )


def _column(name: str) -> re.Match[str] | None:
    """The match of a feature that is a column of the log."""
    return None if LAST_ERROR.fullmatch(name) else LATE.fullmatch(name)


def _uses_errors(names: Sequence[str]) -> bool:
    return any(LAST_ERROR.fullmatch(n) for n in names)
