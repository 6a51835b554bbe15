"""Weights of a learned push from multi-step prediction errors: the Gaussian process as a member of
the PEM.

In weight space a sparse GP is linear, g_j(z) = s_j psi_j(z)'theta_j with psi_j = L_j^-1
k_j(support, z), K = L L' and theta_j ~ N(0, I) (Quinonero-Candela and Rasmussen 2005, JMLR 6;
whitened as in Hensman, Fusi and Lawrence 2013). The weights are estimated like physical parameters:
by the errors of the open-loop model at several horizons, with their sensitivities carried along the
path,

    S+ = A S + G s psi(z),    de/dtheta = -(C S + D s psi(z)),    V = sum w e^2 + sum_j lambda_j |theta_j|^2

from the filter's state, which depends on the weights too: S+ = (A - K C) S + (G - K D) s psi(z) up
to the origin (what the push explains the disturbance states no longer do).

Smoothed disturbances say what pushed the vehicle; in closed loop they are correlated with states
and commands through time delays and feedback, and a regression on them learns that correlation too.
What lowers the errors of a model that runs on alone does not have this bias (omitted lags and clock
errors do not average into it). The strengths lambda_j of the prior are chosen by leaving kinds of
flight out, from the same normal equations: what does not lower the errors of flights unlike those
it has seen, or raises those of any channel group, is switched off. Gauss-Newton with step control;
the inverse Hessian is the posterior covariance up to a factor per group, for nobody knows how many
independent errors overlapping windows hold. The factor follows from how much the weights move when
a kind of flight is left out, against how much they should (`_dispersion`; the jackknife of Wu 1986,
Annals of Statistics 14(4), in the metric of the errors).
"""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
import scipy.cluster.hierarchy
from threadpoolctl import threadpool_limits

from greybox.data import Dataset
from greybox.errors import DataError, FitError
from greybox.estimation.engine import Engine, engine_for
from greybox.estimation.filtering import Filter
from greybox.estimation.record import Record, make_record
from greybox.estimation.settling import RecordGains
from greybox.estimation.smoothing import transitions
from greybox.model.identified import IdentifiedModel
from greybox.model.layer import own_window
from greybox.model.parameter import Parameter
from greybox.residual.discrepancy import feature_function
from greybox.residual.features import features
from greybox.residual.hybrid import HybridModel
from greybox.residual.impulses import impulses, pushed
from greybox.residual.strengths import (
    Halves,
    Maker,
    Normal,
    by_channel,
    choose,
    folds_of,
    judged,
    total,
)
from greybox.residual.weight_space import (
    Candidate,
    alone,
    factors,
    fitted,
    members_of,
    plain_weights,
    silent,
    weighted,
    whitened,
)
from greybox.symbolic import BoolArray, Expr, FloatArray, evaluate, given

HORIZONS = (1, 2, 5, 10, 20, 35, 50)
STRENGTHS = (1e-2, 1e-1, 1.0, 1e1, 1e2, 1e3, np.inf)
"""Prior strengths to choose from; infinite switches the outputs of a group off."""
FEW, BLOCKS = 4, 4
"""With fewer flights than this, stretches of a flight (this many) are left out instead of
flights."""
SMALLEST = 1e-3
"""Least factor on the covariance of the weights."""
CHUNK = 100
"""Strides of the filter whose sensitivities are held in memory at once."""
ORIGINS = 200
"""Origins of predictions whose sensitivities are held in memory at once."""
MANY = 6
"""From this many flights on, flights of a kind are left out together."""
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


@dataclass(frozen=True, kw_only=True, eq=False)
class OpenLoopFit:
    """The fitted posterior and how it came about: prior strength per output, cost before and after,
    share of held-out cost that it saves, `status` ("converged", "iteration limit" or "null":
    nothing was worth learning).

    `left_out`: (flight, horizon in samples, channel group) -> mean squared error with weights that
    have not seen its kind of flight, over that with the weights of all flights (at least 1). Empty
    for null."""

    posterior: Candidate
    strengths: Mapping[str, float]
    cost_before: float
    cost_after: float
    held_out_gain: float
    iterations: int
    status: str
    left_out: Mapping[tuple[str, int, str], float] = field(default_factory=dict)


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
        record."""
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
            windows = self._windows(record, at)
            for j, basis in enumerate(bases):
                own = out[j][some]
                features = basis.spread(states[at].reshape(*shape, -1), windows.reshape(*shape, -1))
                pushed(responses * basis.scale[:, None], features, own)
                for i, through in enumerate(whole):
                    now[j] = own[i] = own[i] + through @ now[j]
        return out

    def _windows(self, record: Record, at: IntArray) -> FloatArray:
        """The commands that a step looks at, of samples `at` (...), (..., n_u (past + 1 +
        future))."""
        width = self.engine.past + 1 + self.engine.future
        return np.asarray(record.inputs[at[..., None] + np.arange(width)].reshape(*at.shape, -1))

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
            windows=self._windows(record, rows[:, None] + np.arange(length)),
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

    def normal(
        self, record: Record, bases: Sequence[Basis], blocks: int = 1, *, by_horizon: bool = False
    ) -> list[list[Normal]]:
        """Per basis the cost and normal equations of one record, in `blocks` parts along its time.
        With `by_horizon` every channel group at every horizon is a group of its own, horizon by
        horizon. All bases have the same outputs."""
        p, rows, states, e, mask = self.errors(record)
        carried = self.filtered(record, p, states, bases)
        c, layers = len(self.groups), self.chosen.size if by_horizon else 1
        gradient = [np.zeros((blocks, layers * c, b.size)) for b in bases]
        hessian = [np.zeros((blocks, layers * c, b.size, b.size)) for b in bases]
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
        weighed = e * e * mask * self.scales
        weighed = weighed if by_horizon else weighed.sum(axis=1, keepdims=True)
        cost = np.stack(
            [weighed[:, :, members].sum(axis=2) for members in self.groups], axis=2
        ).reshape(rows.size, -1)
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
        to gradient (C, P) and Hessian (C, P, P), C groups of channels or as many of every
        horizon."""
        layers = len(gradient) // len(self.groups)
        for i, steps in enumerate(np.array_split(np.arange(self.chosen.size), layers)):
            part = slice(steps[0], steps[-1] + 1)
            for g, members in enumerate(self.groups):
                flat = slope[part].take(members, axis=2).reshape(-1, slope.shape[3])
                row = g + len(self.groups) * i
                gradient[row] += flat.T @ error[part].take(members, axis=2).ravel()
                hessian[row] += flat.T @ flat  # half a product: BLAS sees that it is symmetric

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

    def kinds(self, basis: Basis) -> list[int]:
        """Number of the kind of flight of every record: flights that cover the features alike are
        one kind.

        Mean and spread of every feature, clustered by average linkage into half as many kinds as
        flights (three at least); below `MANY` flights every flight is a kind of its own.
        """
        flights = list(dict.fromkeys(r.flight for r in self.records))
        numbers = {f: i for i, f in enumerate(flights)}
        if len(flights) >= MANY:
            rows: dict[str, list[FloatArray]] = {f: [] for f in flights}
            for record in self.records:
                _, at, states, _, _ = self.errors(record)
                seen = evaluate(basis.look, states[at], self._windows(record, at))
                rows[record.flight].append(seen)
            z = {
                f: (np.concatenate(v) - basis.posterior.input_mean) / basis.posterior.input_scale
                for f, v in rows.items()
            }
            table = np.array([np.concatenate([v.mean(axis=0), v.std(axis=0)]) for v in z.values()])
            tree = scipy.cluster.hierarchy.linkage(table, method="average")
            found = scipy.cluster.hierarchy.fcluster(
                tree, max(3, -(-len(flights) // 2)), criterion="maxclust"
            )
            if len(set(found.tolist())) > 1:  # of one kind only nothing could be left out
                numbers = dict(zip(flights, found.tolist(), strict=True))
        return [numbers[r.flight] for r in self.records]


def fit_open_loop(
    model: IdentifiedModel,
    candidates: Mapping[str, Candidate],
    data: Dataset,
    *,
    maker: Maker | None = None,
    horizons: Sequence[int] = HORIZONS,
    stride: int = 10,
    strengths: Sequence[float] = STRENGTHS,
    iterations: int = 4,
    progress: Progress | None = None,
) -> tuple[OpenLoopFit, str, dict[str, float]]:
    """(fit, name of the candidate chosen, name -> share of held-out cost that each candidate
    saves).

    Of every candidate the kernels and support points (or features) stay and the weights are
    refitted by multi-step errors on the flights of `data`. With a `maker` the best candidate must
    stand again with features that have not seen the flights they are judged on; where it does not
    the next one is asked, and none is learned where none does. `model` is the identified model
    without the learned part; `horizons` are samples, `stride` the samples between the starts of two
    predictions. Raises `DataError` for flights that are too short, `FitError` where the model
    itself does not stay finite.
    """
    say = progress or (lambda _text, _share: None)
    with threadpool_limits(limits=1):
        paths = Paths(model, data, horizons=horizons, stride=stride)
        bases = {label: Basis(model, posterior) for label, posterior in candidates.items()}
        outputs = next(iter(candidates.values())).outputs.names
        cut = _Cut.of(paths, next(iter(bases.values())))
        parts = paths.all_normal(bases, cut.blocks, lambda text, share: say(text, 0.6 * share))
        found = {
            label: choose(
                judged(own, cut.folds),
                by_channel(own, "cost"),
                outputs,
                strengths,
                bases[label].members,
            )
            for label, own in parts.items()
        }
        best = max(found, key=lambda label: found[label][1])
        if maker is not None:
            best = _judged_apart(paths, maker, found, cut, strengths, say)
        gains = {label: gain for label, (_, gain) in found.items()}
        chosen, gain = found[best]
        factor = _dispersion(parts[best], cut.folds, bases[best], chosen)
        result, theta = _iterate(
            paths,
            bases[best],
            parts[best],
            chosen,
            factor,
            iterations,
            lambda text, s: say(text, 0.6 + 0.3 * s),
        )
        if result.status != "null":
            say("errors of kinds of flight left out", 0.9)
            del parts
            left_out = _left_out(paths, bases[best], theta, chosen, cut)
            result = replace(result, held_out_gain=gain, left_out=left_out)
    return result, best, gains


@dataclass(frozen=True, kw_only=True)
class _Cut:
    """How records are left out: the kind of flight of every record, and the blocks it is cut into.
    Of many flights a kind is left out whole, of few a block alone."""

    kinds: tuple[int, ...]
    blocks: int

    @classmethod
    def of(cls, paths: Paths, basis: Basis) -> _Cut:
        many = len({r.flight for r in paths.records}) >= FEW
        return cls(kinds=tuple(paths.kinds(basis)), blocks=1 if many else BLOCKS)

    @cached_property
    def folds(self) -> list[list[int]]:
        """Blocks of all records, in order, that are left out together."""
        owners = [
            str(kind) if self.blocks == 1 else f"{i} {b}"
            for i, kind in enumerate(self.kinds)
            for b in range(self.blocks)
        ]
        return folds_of(owners)


def _judged_apart(
    paths: Paths,
    maker: Maker,
    found: dict[str, tuple[FloatArray, float]],
    cut: _Cut,
    strengths: Sequence[float],
    say: Progress,
) -> str:
    """The best candidate that stands with features made without the flights that judge it.

    Changes `found` (strengths, share saved) of those that were asked to what they saved so; a
    candidate that the half of the flights does not offer saves nothing.
    """
    flights = [r.flight for r in paths.records]
    halves = Halves.of(
        flights,
        dict(zip(flights, cut.kinds, strict=True)),
        cut.blocks,
        [r.n for r in paths.records],
        maker.flights,
    )
    order = sorted(found, key=lambda label: found[label][1], reverse=True)
    for label in order:
        chosen = found[label][0]
        if not np.isfinite(chosen).any():
            continue
        say(f"{label}: again without the flights that judge it", 0.6)
        made = {str(h): maker.again(label, rows) for h, rows in enumerate(halves.rows)}
        bases = {h: Basis(paths.model, c) for h, c in made.items() if c is not None}
        silence, nothing = np.full(chosen.shape, np.inf), 0.0
        found[label] = silence, nothing
        if len(bases) == len(made):
            parts = paths.all_normal(bases, cut.blocks, lambda _text, _share: None)
            outputs = next(iter(bases.values())).posterior.outputs.names
            both = halves.judged([parts[h] for h in made], cut.folds)
            found[label] = choose(
                both, by_channel(parts["0"], "cost"), outputs, strengths, bases["0"].members
            )
        if np.isfinite(found[label][0]).any():
            return label
    return order[0]


def _iterate(
    paths: Paths,
    basis: Basis,
    parts: list[Normal],
    chosen: FloatArray,
    factor: FloatArray,
    iterations: int,
    say: Progress,
) -> tuple[OpenLoopFit, FloatArray]:
    """Gauss-Newton with step control from zero weights: (fit, whitened weights (P,))."""
    before = float(total(parts, "cost"))
    strengths = dict(zip(basis.posterior.outputs.names, chosen.tolist(), strict=True))
    if not np.isfinite(chosen).any():
        null = OpenLoopFit(
            posterior=silent(basis.posterior),
            strengths=strengths,
            cost_before=before,
            cost_after=before,
            held_out_gain=0.0,
            iterations=0,
            status="null",
        )
        return null, np.zeros(basis.size)
    say("compiling the weighted model", 0.0)
    paths.engine = engine_for(
        WeightedHybrid(inner=paths.model.dynamics, posterior=basis.posterior), ()
    )
    end = _gauss_newton(paths, basis, parts, chosen, iterations, say)
    paths.extra = basis.weights(end.theta)
    hessian = alone(total(end.parts, "hessian"), basis.members, basis.m)
    hessian = hessian + np.diag(np.repeat(np.where(np.isfinite(chosen), chosen, 1.0), basis.m))
    found = OpenLoopFit(
        posterior=fitted(basis.posterior, end.theta, _inverse(hessian), chosen, factor),
        strengths=strengths,
        cost_before=before,
        cost_after=paths.cost(),
        held_out_gain=0.0,
        iterations=end.iterations,
        status=end.status,
    )
    return found, end.theta


@dataclass(frozen=True, kw_only=True, eq=False)
class _End:
    """Where the iterations end: whitened weights (P,), and the normal equations that were solved
    last."""

    theta: FloatArray
    parts: list[Normal]
    iterations: int
    status: str


def _gauss_newton(
    paths: Paths,
    basis: Basis,
    parts: list[Normal],
    chosen: FloatArray,
    iterations: int,
    say: Progress,
) -> _End:
    """Lower the penalised cost from zero weights; outputs of infinite strength stay silent."""
    before = value = float(total(parts, "cost"))
    on = np.isfinite(np.repeat(chosen, basis.m))
    prior, at = np.repeat(chosen, basis.m)[on], np.ix_(on, on)
    theta = np.zeros(basis.size)
    status, done = "iteration limit", 0
    for done in range(1, iterations + 1):
        step = np.zeros(basis.size)
        step[on], g = _newton(
            total(parts, "hessian")[at], total(parts, "gradient")[on], prior, theta[on], basis
        )
        moved, new = theta, np.inf
        for share in (1.0, 0.5, 0.25, 0.125):
            moved = theta + share * step
            paths.extra = basis.weights(moved)
            new = paths.cost() + basis.members * float(prior @ moved[on] ** 2)
            if new < value:
                break
        if not new < value:
            status = "converged"
            break
        small = value - new < 2e-2 * (before - new)
        theta, value = moved, new
        say(f"step {done}: cost {value:.6g}", done / iterations)
        if small or float(-step[on] @ g) < 1e-5 * before:
            status = "converged"
            break
        if done < iterations:
            parts = [n for r in paths.records for n in paths.normal(r, [basis])[0]]
    return _End(theta=theta, parts=parts, iterations=done, status=status)


def _newton(
    hessian: FloatArray, gradient: FloatArray, prior: FloatArray, theta: FloatArray, basis: Basis
) -> tuple[FloatArray, FloatArray]:
    """(Gauss-Newton step of theta (P,), slope of the penalised cost): Hessian (P, P) and gradient
    (P,) of the cost at theta.

    Each member k of an ensemble with mean theta solves its own normal equations, linearised along
    the path of the mean: H_kk theta_k + prior theta_k = (H theta)_k - g_k. With one member this is
    the ordinary step.
    """
    own, block = basis.members * theta, alone(hessian, basis.members, basis.m)
    slope = gradient + prior * own + (block @ own - hessian @ theta)
    step = -np.linalg.solve(block + np.diag(prior), slope) / basis.members
    return np.asarray(step, dtype=np.float64), slope


def _left_out(
    paths: Paths,
    basis: Basis,
    theta: FloatArray,
    chosen: FloatArray,
    cut: _Cut,
) -> dict[tuple[str, int, str], float]:
    """As `OpenLoopFit.left_out`, in the quadratic model of the cost around the fitted weights."""
    learned = np.isfinite(chosen)
    few, on = basis.only(learned), np.repeat(learned, basis.m)
    parts = [
        n for r in paths.records for n in paths.normal(r, [few], cut.blocks, by_horizon=True)[0]
    ]
    flights = [r.flight for r in paths.records for _ in range(cut.blocks)]
    prior = np.repeat(chosen, basis.m)[on]
    whole_h, whole_g = total(parts, "hessian"), total(parts, "gradient")
    seen: dict[str, FloatArray] = {}
    unseen: dict[str, FloatArray] = {}
    for fold in cut.folds:
        own = [parts[i] for i in fold]
        left_h, left_g = whole_h - total(own, "hessian"), whole_g - total(own, "gradient")
        d, _ = _newton(left_h, left_g, prior, theta[on], basis)
        for n, i in zip(own, fold, strict=True):
            after = n.cost + 2 * n.gradient @ d + (n.hessian @ d) @ d
            seen[flights[i]] = seen.get(flights[i], 0.0) + n.cost
            unseen[flights[i]] = unseen.get(flights[i], 0.0) + after
    names = list(itertools.product((paths.chosen + 1).tolist(), paths.labels))
    return {
        (flight, h, label): max(1.0, float(value / before)) if before > 0 else 1.0
        for flight, values in unseen.items()
        for (h, label), value, before in zip(names, values, seen[flight], strict=True)
    }


def _dispersion(
    parts: Sequence[Normal], folds: Sequence[Sequence[int]], basis: Basis, chosen: FloatArray
) -> FloatArray:
    """Factor (n_out,) on the covariance of the weights, one per group of outputs.

    Where a fold f is left out the weights move by d = C_f r_f with C_f = (H - H_f + Lambda)^-1 and
    the fold's gradient r_f at the fit to all. If the weighted errors had unit variance and were
    independent, d had the covariance C_f - C; the factor is the sum of d' H_f d over its
    expectation, in the block of the group. Prior and data share it, so that the fit itself does not
    change.
    """
    on = np.isfinite(np.repeat(chosen, basis.m))
    out = np.ones(basis.outputs)
    if not on.any():
        return out
    at, prior = np.ix_(on, on), np.diag(np.repeat(chosen, basis.m)[on])
    h, g = (
        alone(total(parts, "hessian")[at], basis.members, basis.m) + prior,
        total(parts, "gradient")[on],
    )
    theta, whole = -np.linalg.solve(h, g), np.linalg.inv(h)
    groups = np.repeat([n.split(".")[0] for n in basis.posterior.outputs.names], basis.m)[on]
    kinds = list(dict.fromkeys(groups.tolist()))
    moved, expected = dict.fromkeys(kinds, 0.0), dict.fromkeys(kinds, 0.0)
    for fold in folds:
        own = [parts[i] for i in fold]
        hf, gf = (
            alone(total(own, "hessian")[at], basis.members, basis.m),
            total(own, "gradient")[on],
        )
        without = np.linalg.inv(h - hf)
        d = without @ (gf + hf @ theta)
        for kind in kinds:
            rows = np.flatnonzero(groups == kind)
            block = np.ix_(rows, rows)
            moved[kind] += float(d[rows] @ hf[block] @ d[rows])
            expected[kind] += float(np.sum(hf[block] * (without[block] - whole[block])))
    for j, name in enumerate(basis.posterior.outputs.names):
        kind = name.split(".")[0]
        if kind in moved and expected[kind] > 0:
            out[j] = max(moved[kind] / expected[kind], SMALLEST)
    return out


def _inverse(hessian: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.inv(hessian), dtype=np.float64)
