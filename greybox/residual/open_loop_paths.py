"""Paths: errors of a model that runs on alone, and how they change with the weights of a learned
push.

In weight space a sparse GP is linear, g_j(z) = s_j psi_j(z)'theta_j with psi_j = L_j^-1
k_j(support, z), K = L L' and theta_j ~ N(0, I) (Quinonero-Candela and Rasmussen 2005, JMLR 6;
whitened as in Hensman, Fusi and Lawrence 2013). The sensitivities to the weights are carried along
the open-loop path,

    S+ = A S + G s psi(z),    de/dtheta = -(C S + D s psi(z))

from the filter's state, which depends on the weights too: S+ = (A - K C) S + (G - K D) s psi(z) up
to the origin (what the push explains the disturbance states no longer do).
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from greybox.data import Dataset
from greybox.errors import DataError, FitError
from greybox.estimation.engine import Engine
from greybox.estimation.filtering import Filter
from greybox.estimation.record import Record, make_record
from greybox.estimation.settling import RecordGains
from greybox.estimation.smoothing import transitions
from greybox.model.identified import IdentifiedModel
from greybox.model.layer import own_window
from greybox.model.parameter import Parameter
from greybox.residual.features import feature_function, features
from greybox.residual.hybrid import HybridModel
from greybox.residual.impulses import impulses, pushed
from greybox.residual.strengths import Normal
from greybox.residual.weight_space import (
    Candidate,
    factors,
    members_of,
    plain_weights,
    weighted,
    whitened,
)
from greybox.symbolic import BoolArray, Expr, FloatArray, evaluate, given

CHUNK = 100
"""Strides of the filter whose sensitivities are held in memory at once."""
ORIGINS = 200
"""Origins of predictions whose sensitivities are held in memory at once."""
Progress = Callable[[str, float], None]
IntArray = npt.NDArray[np.int_]


@dataclass(frozen=True, kw_only=True, eq=False)
class WeightedHybrid(HybridModel):
    """A hybrid whose GP weights are parameters, `gp.<output>.<i>` after those of `inner`: compiled
    once, fitted often."""

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Inner parameters, then the weights output by output."""
        own = [
            Parameter(name=f"gp.{n}.{i}", unit="-", nominal=0.0, scale=1.0)
            for n in self.posterior.outputs.names
            for i in range(self.posterior.points)
        ]
        return (*self.inner.parameters, *own)

    def _weighted(self, x: Expr, window: Expr, p: Expr) -> Expr:
        z = features(self.inner, self.posterior.inputs.names, x, window)
        return weighted(self.posterior, z, p[len(self.inner.parameters) :])

    def step(self, t: Expr, x: Expr, window: Expr, p: Expr, w: Expr, dt: Expr) -> Expr:
        """One sample under the weighted push."""
        push = self._spread @ self._weighted(x, window, p)
        own = p[: len(self.inner.parameters)]
        return self.inner.step(t, x, own_window(self.inner, window), own, w + push, dt)

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
        """Outputs under the weighted push."""
        push = self._spread @ self._weighted(x, window, p)
        own = p[: len(self.inner.parameters)]
        return self.inner.output(
            t, x, own_window(self.inner, window), own, w + push, dt, *given(lasting)
        )


class Basis:
    """s_j psi_j(z) of a candidate (`greybox.residual.weight_space`), along the paths of a model."""

    def __init__(self, model: IdentifiedModel, posterior: Candidate) -> None:
        self.posterior = posterior
        self.m, self.outputs = posterior.points, len(posterior.outputs)
        self.size = self.m * self.outputs
        self.members = members_of(posterior)
        self.rows = [model.dynamics.noises[n] for n in posterior.outputs.names]
        self.look = feature_function(model.dynamics, posterior.inputs.names)
        self.factors = factors(posterior)
        self.at = list(range(self.outputs))
        self.scale = np.asarray(posterior.output_scale)

    def only(self, on: BoolArray) -> Basis:
        """Of the outputs `on` (n_out,) alone, for `spread`: their weights, their rows."""
        found = copy.copy(self)
        found.at = [j for j in self.at if on[j]]
        found.rows = [self.rows[j] for j in found.at]
        found.scale = self.scale[[self.at.index(j) for j in found.at]]
        found.outputs, found.size = len(found.at), len(found.at) * self.m
        return found

    def weights(self, theta: FloatArray) -> FloatArray:
        """Weights of the kernel values, (P,), of whitened theta (P,)."""
        return plain_weights(self.posterior, self.factors, theta)

    def spread(self, states: FloatArray, windows: FloatArray) -> list[FloatArray]:
        """psi per output at states (..., n_x) and command windows alike, (..., M): d push/d theta
        in its own weights over its `scale` (n_out,). Outputs that share share the array."""
        post, before = self.posterior, states.shape[:-1]
        flat = (a.reshape(-1, a.shape[-1]) for a in (states, windows))
        x = ((evaluate(self.look, *flat) - post.input_mean) / post.input_scale).T
        psi = whitened(post, self.factors, x)
        known = {id(v): v.reshape(*before, self.m) for v in psi}
        return [known[id(psi[j])] for j in self.at]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Ahead:
    """Open-loop paths of m origins over L samples: states (m, L, n_x), command windows (m, L, .),
    transitions (m, L, n_d, n_d) and slopes of the innovations (m, L, n_e, n_d)."""

    states: FloatArray
    windows: FloatArray
    transition: FloatArray
    seen: FloatArray


class Paths:
    """Open-loop predictions of a model along all flights: errors, and their normal equations for
    any number of bases.

    `engine` runs the model itself, or a `WeightedHybrid` of it; `extra` are the parameters after
    the model's own.
    """

    def __init__(
        self, model: IdentifiedModel, data: Dataset, *, horizons: Sequence[int], stride: int
    ) -> None:
        self.model, self.stride = model, stride
        self.runner = Filter(model)
        self.engine: Engine = self.runner.engine
        self.extra = np.zeros(0)
        self.chosen = np.array(sorted(set(horizons))) - 1
        labels = model.channel_groups
        self.labels = list(dict.fromkeys(labels))
        self.groups = [[i for i, n in enumerate(labels) if n == g] for g in self.labels]
        records = [make_record(self.engine, s) for f in data for s in f.segments]
        self.records = [r for r in records if r.n > max(horizons) + stride]
        if not self.records:
            raise DataError(
                "no flight is long enough for multi-step errors",
                expected=f"over {max(horizons)} samples",
            )
        _, self.push, _, self.through = self.runner.linear
        total: FloatArray = np.zeros((self.chosen.size, self.engine.ne))
        count = np.zeros_like(total)
        for record in self.records:
            _, _, _, e, mask = self.errors(record)
            total, count = total + (e * e * mask).sum(axis=0), count + mask.sum(axis=0)
        # Every horizon and channel weighs alike; errors of overlapping windows share what caused
        # them.
        share = stride / (self.chosen.size * (int(self.chosen[-1]) + 1))
        self.scales = np.where(
            total > 0, share * np.maximum(count, 1) / np.where(total > 0, total, 1.0), 0.0
        )

    def errors(
        self, record: Record
    ) -> tuple[FloatArray, IntArray, FloatArray, FloatArray, FloatArray]:
        """(p, rows (m,), filter's states (n, n_x), errors (m, H, n_e), mask alike) of one
        record. Raises `FitError` for a prediction that is not finite."""
        p = np.concatenate([self.model.flight_vector(record.flight), self.extra])
        found = self.gains(record)
        run = self.engine.run(
            x0=record.x0,
            pattern=found.pattern,
            gains=found.tables()[0],
            p=p,
            want=frozenset({"states"}),
            **record.samples,
        )
        if run.failed_at is not None or run.states is None:
            raise FitError(f"the prediction of flight {record.flight} is not finite")
        length = int(self.chosen[-1]) + 1
        rows = np.arange(min(self.stride, record.n - length), record.n - length + 1, self.stride)
        whole = np.full(rows.size, length)
        ahead = self.engine.windows(
            starts=run.states[rows],
            rows=rows,
            lengths=whole,
            tails=whole,
            p=p,
            **record.samples,
        )
        if ahead.failed_in is not None:
            raise FitError(f"the prediction of flight {record.flight} is not finite")
        e = ahead.innovations.reshape(rows.size, length, self.engine.ne)[:, self.chosen]
        return p, rows, run.states, e, record.mask[rows[:, None] + self.chosen]

    def gains(self, record: Record) -> RecordGains:
        """The filter of one record."""
        return self.runner.settling.gains(record, record.spread)

    def filtered(
        self, record: Record, p: FloatArray, states: FloatArray, bases: Sequence[Basis]
    ) -> list[FloatArray]:
        """Per basis the sensitivity (m, n_d, P) of the filter's state at every `stride` samples to
        the whitened weights."""
        m, nd = (record.n - int(self.chosen[-1]) - 1) // self.stride, self.engine.nd
        found = self.gains(record)
        table = found.tables()[0].gain
        now = [np.zeros((nd, b.size)) for b in bases]
        out = [np.empty((m, nd, b.size)) for b in bases]
        for begin in range(0, m, CHUNK):
            some = slice(begin, min(begin + CHUNK, m))
            shape = (some.stop - begin, self.stride)
            at = np.arange(begin * self.stride, some.stop * self.stride)
            step = transitions(self.engine, states[at], at, record.inputs, p, record.dt)
            assert step.end_sensitivity is not None
            assert step.sensitivity is not None
            gain = table[found.pattern[at]]
            # `sensitivity` is -C; gains have zero columns for what is not measured.
            closed = step.end_sensitivity + gain @ step.sensitivity
            rows = bases[0].rows
            into = self.push[:, rows] - gain @ self.through[:, rows]
            responses, whole = impulses(
                np.broadcast_to(np.eye(nd), (shape[0], nd, nd)),
                closed.reshape(*shape, nd, nd),
                into.reshape(*shape, nd, len(rows)),
            )
            windows = self.windows(record, at)
            for j, basis in enumerate(bases):
                own = out[j][some]
                features = basis.spread(states[at].reshape(*shape, -1), windows.reshape(*shape, -1))
                pushed(responses * basis.scale[:, None], features, own)
                for i, through in enumerate(whole):
                    now[j] = own[i] = own[i] + through @ now[j]
        return out

    def windows(self, record: Record, at: IntArray) -> FloatArray:
        """The commands that a step looks at, of samples `at` (...), (..., n_u (past + 1 +
        future))."""
        return self.engine.command_windows(record.inputs, at)

    def cost(self) -> float:
        """Weighted square errors; infinite where a prediction is not finite."""
        try:
            return float(
                sum(
                    (e * e * k * self.scales).sum()
                    for _, _, _, e, k in map(self.errors, self.records)
                )
            )
        except FitError:
            return np.inf

    def _ahead(self, record: Record, p: FloatArray, states: FloatArray, rows: IntArray) -> _Ahead:
        """The open-loop paths from `states` (m, n_x) at `rows` (m,)."""
        m, length, nd = rows.size, int(self.chosen[-1]) + 1, self.engine.nd
        x = np.empty((m, length, self.engine.nx))
        a, seen = np.empty((m, length, nd, nd)), np.empty((m, length, self.engine.ne, nd))
        for h in range(length):
            x[:, h] = states
            step = transitions(self.engine, states, rows + h, record.inputs, p, record.dt)
            assert step.end_sensitivity is not None
            assert step.sensitivity is not None
            a[:, h], seen[:, h], states = step.end_sensitivity, step.sensitivity, step.ends
        return _Ahead(
            states=x,
            windows=self.windows(record, rows[:, None] + np.arange(length)),
            transition=a,
            seen=seen,
        )

    def _slopes(
        self,
        ahead: _Ahead,
        bases: Sequence[Basis],
        carried: Sequence[FloatArray],
        root: FloatArray,
    ) -> Iterator[FloatArray]:
        """Per basis the slopes (H, m, n_e, P) of the errors along `ahead`, whose starts have the
        sensitivities `carried` (m, n_d, P), times `root` (m, H, n_e). The next basis takes the
        place of one in memory."""
        rows, m = bases[0].rows, len(ahead.states)
        entry = np.broadcast_to(self.push[:, rows], (m, 1, self.engine.nd, len(rows)))
        direct = np.broadcast_to(
            -self.through[:, rows][..., None], (m, self.engine.ne, len(rows), 1)
        )
        found = []
        for i, h in enumerate(self.chosen.tolist()):
            before, start = impulses(
                ahead.seen[:, h], ahead.transition[:, :h], np.repeat(entry, h, axis=1)
            )
            whole, weight = np.concatenate([before, direct], axis=3), root[:, i, :, None]
            found.append((whole * weight[..., None], start * weight))
        shape = (self.chosen.size, m, self.engine.ne)
        room = np.empty(math.prod(shape) * max(b.size for b in bases))
        for basis, own in zip(bases, carried, strict=True):
            features = basis.spread(ahead.states, ahead.windows)
            slope = room[: math.prod(shape) * basis.size].reshape(*shape, basis.size)
            for i, (responses, start) in enumerate(found):
                pushed(responses * basis.scale[:, None], features, slope[i])
                slope[i] += start @ own
            yield slope

    def normal(self, record: Record, bases: Sequence[Basis], blocks: int = 1) -> list[list[Normal]]:
        """Per basis the cost and normal equations of one record, in `blocks` parts along its time.
        All bases have the same outputs."""
        p, rows, states, e, mask = self.errors(record)
        carried = self.filtered(record, p, states, bases)
        c = len(self.groups)
        gradient = [np.zeros((blocks, c, b.size)) for b in bases]
        hessian = [np.zeros((blocks, c, b.size, b.size)) for b in bases]
        part = np.arange(rows.size) * blocks // rows.size
        root = np.sqrt(self.scales * mask)
        for b in range(blocks):
            mine = np.flatnonzero(part == b)
            for begin in range(0, mine.size, ORIGINS):
                some = mine[begin : begin + ORIGINS]
                ahead = self._ahead(record, p, states[rows[some]], rows[some])
                slopes = self._slopes(ahead, bases, [own[some] for own in carried], root[some])
                error = np.swapaxes(root[some] * e[some], 0, 1)
                for k, slope in enumerate(slopes):
                    self._add(slope, error, gradient[k][b], hessian[k][b])
        weighed = (e * e * mask * self.scales).sum(axis=1)
        cost = np.stack([weighed[:, members].sum(axis=1) for members in self.groups], axis=1)
        return [
            [
                Normal(
                    cost=cost[part == b].sum(axis=0),
                    gradient=gradient[k][b],
                    hessian=hessian[k][b],
                )
                for b in range(blocks)
            ]
            for k in range(len(bases))
        ]

    def _add(
        self,
        slope: FloatArray,
        error: FloatArray,
        gradient: FloatArray,
        hessian: FloatArray,
    ) -> None:
        """Add the normal equations of weighted slopes (H, m, n_e, P) of weighted errors (H, m, n_e)
        to gradient (C, P) and Hessian (C, P, P) of C groups of channels."""
        for g, members in enumerate(self.groups):
            flat = slope.take(members, axis=2).reshape(-1, slope.shape[3])
            gradient[g] += flat.T @ error.take(members, axis=2).ravel()
            hessian[g] += flat.T @ flat  # half a product: BLAS sees that it is symmetric

    def all_normal(
        self, bases: Mapping[str, Basis], blocks: int, say: Progress
    ) -> dict[str, list[Normal]]:
        """Normal equations of every basis: `blocks` parts of every record, in order."""
        parts: dict[str, list[Normal]] = {label: [] for label in bases}
        for i, record in enumerate(self.records):
            say(f"sensitivities of {record.flight}", i / len(self.records))
            for label, normals in zip(
                bases, self.normal(record, list(bases.values()), blocks), strict=True
            ):
                parts[label] += normals
        return parts
