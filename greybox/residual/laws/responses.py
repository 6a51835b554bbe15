"""Responses: what an unmodelled force or torque would have done to the innovations, and regression
on that.

A wrench w_k that acts through the process noise's channels moves the predicted state and with it
the innovations,

    d_{k+1} = (A_k - K C_k) d_k + (G_k - K D_k) w_k,    e_k = C_k d_k + D_k w_k,

linear in w, along the flight that the filter saw: regression of the whitened innovations on
whitened responses estimates a law's coefficients (Ljung 1999, sec. 7.6). It uses every sample, and
what the fit bent elsewhere is estimated along, unlike regression on a smoothed disturbance: what a
change of a number that the fit had does to the innovations is a column, too. The filter has no
disturbance states: it would take a slow law for noise. Its innovations are coloured where something
is missing, so that it is left to selection on stretches and flights that were left out, not to a
standard error, to say what is a law.
"""

from __future__ import annotations

import functools
import itertools
import operator
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from greybox.data import Dataset, Segment
from greybox.estimation.filtering import Filter, Filtered
from greybox.estimation.gain import Linearisation, linearisation_anywhere
from greybox.estimation.result import Estimate
from greybox.model.identified import IdentifiedModel
from greybox.model.layer import physics_of
from greybox.residual.discrepancy import smoothed_features
from greybox.residual.features import feature_function
from greybox.residual.laws.bends import Bends
from greybox.residual.laws.lagged import remembered_terms
from greybox.residual.laws.normal_equations import RIDGE, Normal, solve
from greybox.residual.laws.own_terms import own_terms
from greybox.residual.laws.terms import Term, terms
from greybox.symbolic import FloatArray, IntArray

STRETCHES, MOST = 10, 40
"""Parts into which few flights are cut, about, and how many parts there are at most."""
SAMPLES = 100_000
"""Samples that laws are sought in, the same number from the start of every segment."""
CHUNK = 256
"""Samples whose responses are kept at once."""
REWEIGHTED = 3
"""How often channels are weighed anew by what is left of them."""


def stretches(n: int, flights: int) -> list[slice]:
    """One flight of n rows in equal parts, about `STRETCHES` in all `flights`."""
    edges = np.linspace(0, n, max(2, -(-STRETCHES // max(flights, 1))) + 1).round().astype(int)
    return [slice(a, b) for a, b in itertools.pairwise(edges) if b > a]


@dataclass(frozen=True, kw_only=True, eq=False)
class Library:
    """Columns (axis and term); what they, after them a constant push on every axis, and last a
    change of every number of the fit do to the whitened innovations; and how the smoothed
    disturbance of every axis follows the terms, a constant, and what such a change adds to that
    axis, to the next, and so on."""

    columns: list[tuple[str, Term]]
    innovations: Normal
    smoothed: dict[str, Normal]


def library(
    model: IdentifiedModel,
    disturbed: IdentifiedModel,
    data: Dataset,
    names: Sequence[str],
    axes: Sequence[str],
    fitted: Mapping[str, Estimate],
    *,
    memory: bool = True,
) -> Library:
    """Terms for `axes` on all flights, those with a `memory` too. `disturbed` is `model` with
    disturbance states, whose smoothed states the terms are evaluated at; `names` are the features
    that `terms` reads, `fitted` what a fit found.

    The innovations are those of `model`: a filter with disturbance states takes most of a slow law
    for noise.
    """
    plain, lin = Filter(model), linearisation_anywhere(model.dynamics)
    bends = Bends.of(model.dynamics, fitted)
    segments = [(f.name, s) for f in data for s in f.segments]
    longest = max(SAMPLES // len(segments), 2)
    segments = [(name, s.rows(0, longest) if s.n > longest else s) for name, s in segments]
    z, wrench = _smoothed(disturbed, [s for _, s in segments], names, axes)
    columns = _columns(model, z, names, axes, memory=memory)
    places = [model.dynamics.noises[axis] for axis in (*(axis for axis, _ in columns), *axes)]
    many = sum(len(stretches(len(own), len(segments))) for own in wrench)
    runs = [plain.run(segment) for _, segment in segments]
    scales = noise_scales(plain, lin, runs, places[len(columns) :], bends)
    blocks, at = _Blocks(many=many), 0
    for (flight, _), run, own in zip(segments, runs, wrench, strict=True):
        pushes = np.column_stack(
            [*(t.values[at : at + len(own)] for _, t in columns), np.ones((len(own), len(axes)))]
        )
        at += len(own)
        parts = stretches(len(own), len(segments))
        pushed = Pushed(runner=plain, lin=lin, run=run, pushes=pushes, places=places, bends=bends)
        for part, normal in zip(parts, responses(pushed, parts, scales), strict=True):
            bent = bends.wrenches(run, part, lin, places[len(columns) :])
            x = np.column_stack([pushes[part, : len(columns) + 1], bent.reshape(len(bent), -1)])
            blocks.add(flight, normal, x, own[part].T)
    innovations, smoothed = blocks.joined(axes)
    for i, above, sigma in bends.beliefs():
        innovations = innovations.believing(len(places) + i, above, sigma)
    return Library(columns=columns, innovations=innovations, smoothed=smoothed)


@dataclass(kw_only=True, eq=False)
class _Blocks:
    """Whitened innovations and smoothed pushes of `many` stretches that come one after the other. A
    fleet has more of them than are needed: neighbours are taken together, `MOST` in all."""

    many: int
    number: int = 0
    seen: dict[int, Normal] = field(default_factory=dict)
    follows: dict[int, list[Normal]] = field(default_factory=dict)
    owners: dict[int, str] = field(default_factory=dict)

    def add(self, flight: str, normal: Normal, x: FloatArray, pushes: FloatArray) -> None:
        """The next stretch: its innovations, and the terms x (n, k) that the pushes (n_axes, n)
        follow."""
        block = self.number * min(MOST, self.many) // self.many
        self.number += 1
        shared = x.T @ x
        each = [
            Normal(xx=shared[None], xy=(w @ x)[None], yy=np.array([w @ w]), flights=(flight,))
            for w in pushes
        ]
        if block in self.seen:
            normal = self.seen[block] + normal
            before = self.follows[block]
            xx = before[0].xx + shared  # the same of every axis
            each = [replace(f + e, xx=xx) for f, e in zip(before, each, strict=True)]
        self.seen[block], self.follows[block] = normal, each
        self.owners.setdefault(block, flight)

    def joined(self, axes: Sequence[str]) -> tuple[Normal, dict[str, Normal]]:
        """All blocks: of the innovations, and of the pushes by axis."""
        flights = list(self.owners.values())
        common = np.concatenate([f[0].xx for f in self.follows.values()])
        smoothed = {
            axis: Normal.joined([f[j] for f in self.follows.values()], flights, common)
            for j, axis in enumerate(axes)
        }
        return Normal.joined(list(self.seen.values()), flights), smoothed


def _smoothed(
    disturbed: IdentifiedModel,
    segments: Sequence[Segment],
    names: Sequence[str],
    axes: Sequence[str],
) -> tuple[list[FloatArray], list[FloatArray]]:
    """(features (N_i, n), smoothed disturbances (N_i, axes)) of every segment."""
    runner, look = Filter(disturbed), feature_function(disturbed.dynamics, names)
    rows = [disturbed.dynamics.states.names.index(f"disturbance.{axis}") for axis in axes]
    z, wrench = list[FloatArray](), list[FloatArray]()
    for segment in segments:
        states, features = smoothed_features(runner, segment, look)
        z.append(features)
        wrench.append(states[:, rows])
    return z, wrench


def _columns(
    model: IdentifiedModel,
    z: Sequence[FloatArray],
    names: Sequence[str],
    axes: Sequence[str],
    *,
    memory: bool,
) -> list[tuple[str, Term]]:
    """Axis and term, axis by axis, evaluated at features z (N_i, n) of all segments together."""
    every, physics = np.concatenate(z), physics_of(model.dynamics)
    if physics is None:
        shared = own_terms(model.dynamics, names, every)
        return [(axis, t) for axis in axes for t in shared]
    vehicle = physics.vehicle
    ends = np.cumsum([0, *map(len, z)])
    flown = [slice(a, b) for a, b in itertools.pairwise(ends.tolist())]
    past = remembered_terms(names, every, vehicle, flown, model.sample_time) if memory else []
    return [(axis, t) for axis in axes for t in (*terms(axis, names, every, vehicle), *past)]


@dataclass(frozen=True, kw_only=True, eq=False)
class Pushed:
    """A segment as the filter saw it (`run`), and what may have acted on it: `pushes` (n, t), each
    through the noise channel of its place, and `bends` of the model's numbers."""

    runner: Filter
    lin: Linearisation
    run: Filtered
    pushes: FloatArray
    places: Sequence[int]
    bends: Bends | None = None

    def rows(
        self, parts: Sequence[slice]
    ) -> Iterator[tuple[int, IntArray, FloatArray, FloatArray]]:
        """Chunk by chunk of `parts` (in order and without gaps) the number of its part, the pattern
        (k,) of each sample, the responses (k, n_e, t), first to the pushes and then to the bends,
        and the innovations (k, n_e); zero where there is no reading."""
        run, lin, places, bends = self.run, self.lin, self.places, self.bends
        record, width = run.record, sum(self.runner.model.dynamics.window) + 1
        gain, there = run.gains.tables()[0].gain, run.gains.there
        d = np.zeros((self.runner.engine.nd, len(places)))
        bent = np.zeros((self.runner.engine.nd, len(bends) if bends else 0))
        for number, part in enumerate(parts):
            slopes = np.zeros((part.stop - part.start, there.shape[1], bent.shape[1]))
            if bends:
                slopes, bent = bends.innovations(run, part, bent)
            for begin in range(part.start, part.stop, CHUNK):
                rows = range(begin, min(begin + CHUNK, part.stop))
                pattern = run.gains.pattern[rows.start : rows.stop].astype(np.int64)
                own = slopes[rows.start - part.start : rows.stop - part.start]
                unbent = np.zeros((len(rows), there.shape[1], len(places)))
                out = np.concatenate([unbent, own], axis=2)
                for j, k in enumerate(rows):
                    a, g, c, through = lin.values(
                        run.states[k], record.inputs[k : k + width].T, run.p, record.dt
                    )
                    i = pattern[j]
                    e = (c @ d + through[:, places] * self.pushes[k]) * there[i][:, None]
                    out[j, :, : len(places)] = e
                    d = a @ d + g[:, places] * self.pushes[k] - gain[i] @ e
                known = there[pattern]
                yield number, pattern, out, run.innovations[rows.start : rows.stop] * known


def responses(
    pushed: Pushed, parts: Sequence[slice], scales: FloatArray | float = 1.0
) -> Iterator[Normal]:
    """Normal equations of whitened innovations on whitened responses: one block per part of the
    segment, the parts in order and without gaps. The innovations' standard deviations are those
    that the filter states times `scales` (n_e,)."""
    run = pushed.run
    spread = np.broadcast_to(scales, run.covariance.shape[1:2])
    white = np.linalg.inv(np.linalg.cholesky(run.covariance * spread[:, None] * spread))

    def whitened(pattern: IntArray, out: FloatArray, target: FloatArray) -> Normal:
        x = (white[pattern] @ out).reshape(-1, out.shape[2])
        y = (white[pattern] @ target[:, :, None]).ravel()
        return Normal.of([x], [y], [run.record.flight])

    for _, chunks in itertools.groupby(pushed.rows(parts), key=lambda chunk: chunk[0]):
        yield functools.reduce(operator.add, (whitened(*chunk[1:]) for chunk in chunks))


def noise_scales(
    runner: Filter,
    lin: Linearisation,
    runs: Sequence[Filtered],
    places: Sequence[int],
    bends: Bends,
) -> FloatArray:
    """Standard deviation (n_e,) of every channel's innovations in `runs`, in that which the filter
    states, beside steady pushes through the noise channels `places` and `bends`, which stand beside
    every law. A fit that has none of these takes a large steady push for noise, in which a law
    that is small beside it drowns.

    By expectation and maximisation (Dempster, Laird and Rubin 1977, JRSS B 39(1)): what is not
    known of the coefficients counts as noise, or a channel of few readings, which they meet, would
    have none."""
    t = len(places) + len(bends)
    many = runs[0].covariance.shape[1]
    xx, xy = np.zeros((many, t, t)), np.zeros((many, t))
    yy, stated, readings = np.zeros((3, many))
    for run in runs:
        n = len(run.innovations)
        parts, pushes = stretches(n, len(runs)), np.ones((n, len(places)))
        pushed = Pushed(runner=runner, lin=lin, run=run, pushes=pushes, places=places, bends=bends)
        for _, pattern, out, target in pushed.rows(parts):
            xx += np.einsum("kit,kiu->itu", out, out)
            xy += np.einsum("kit,ki->it", out, target)
            yy += (target**2).sum(axis=0)
            variance = np.diagonal(run.covariance, axis1=1, axis2=2)[pattern]
            stated += (variance * run.gains.there[pattern]).sum(axis=0)
            readings += run.gains.there[pattern].sum(axis=0)
    seen = (yy > 0) & (stated > 0)
    scales = np.ones(many)
    for _ in range(REWEIGHTED):
        weight = np.where(seen, readings / np.where(seen, scales**2 * stated, 1.0), 0.0)
        whole = np.tensordot(weight, xx, 1)
        c = solve(whole, weight @ xy, range(t))
        left = yy - 2 * xy @ c + np.einsum("t,itu,u->i", c, xx, c)
        size = np.sqrt(np.maximum(np.diag(whole), 1e-300))
        errors = np.linalg.inv(whole / size[:, None] / size + RIDGE * np.eye(t))
        unknown = np.einsum("itu,tu->i", xx / size[:, None] / size, errors)
        scales = np.where(seen, np.sqrt(np.maximum(left + unknown, 1e-12 * yy) / stated), 1.0)
    return scales
