"""Weights of a learned push from multi-step prediction errors: the Gaussian process as a member of
the PEM.

The weights are estimated like physical parameters: by the errors of the open-loop model at several
horizons, with their sensitivities (`open_loop_paths`),

    V = sum w e^2 + sum_j lambda_j |theta_j|^2

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

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import scipy.cluster.hierarchy
import scipy.optimize
from threadpoolctl import threadpool_limits

from greybox.data import Dataset
from greybox.estimation.engine import engine_for
from greybox.model.identified import IdentifiedModel
from greybox.residual.open_loop_paths import Basis, Paths, Progress, WeightedHybrid
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
from greybox.residual.weight_space import Candidate, alone, fitted, silent
from greybox.symbolic import FloatArray, evaluate
from greybox.validation.calibration import steps_ahead

HORIZONS, STRIDE = (1, 2, 5, 10, 20, 35, 50), 10
"""Errors of so many samples ahead, and those between the starts of two predictions, at 100 Hz: see
`steps_ahead`."""
STRENGTHS = (1e-2, 1e-1, 1.0, 1e1, 1e2, 1e3, np.inf)
"""Prior strengths to choose from; infinite switches the outputs of a group off."""
FEW, BLOCKS = 4, 4
"""With fewer flights than this, stretches of a flight (this many) are left out instead of
flights."""
SMALLEST = 1e-3
"""Least factor on the covariance of the weights."""
MANY = 6
"""From this many flights on, flights of a kind are left out together."""


@dataclass(frozen=True, kw_only=True, eq=False)
class OpenLoopFit:
    """The fitted posterior and how it came about: prior strength per output, cost before and after,
    share of held-out cost that it saves, `status` ("converged", "iteration limit" or "null":
    nothing was worth learning).

    `unseen`: flight -> squared errors (C,) of the channel groups with weights that have not seen
    its kind of flight, weighed by `scales` (H, n_e). Both are empty for null. `unasked`: candidates
    whose share saved is that of features that saw the flights which judge them."""

    posterior: Candidate
    strengths: Mapping[str, float]
    cost_before: float
    cost_after: float
    held_out_gain: float
    iterations: int
    status: str
    unseen: Mapping[str, FloatArray] = field(default_factory=dict)
    scales: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    unasked: frozenset[str] = frozenset()


def fit_open_loop(
    model: IdentifiedModel,
    candidates: Mapping[str, Candidate],
    data: Dataset,
    *,
    maker: Maker | None = None,
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
    without the learned part. Raises `DataError` for flights that are too short, `FitError` where
    the model itself does not stay finite.
    """
    say = progress or (lambda _text, _share: None)
    with threadpool_limits(limits=1):
        paths = _paths(model, data)
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
        best, unasked = max(found, key=lambda label: found[label][1]), frozenset[str]()
        if maker is not None:
            best, unasked = _judged_apart(paths, maker, found, cut, strengths, say)
        gains = {label: gain for label, (_, gain) in found.items()}
        chosen, gain = found[best]
        own = parts.pop(best)
        parts.clear()
        result = _fitted(paths, bases[best], own, chosen, cut, iterations, say)
    return replace(result, held_out_gain=gain, unasked=unasked), best, gains


def fit_again(
    model: IdentifiedModel,
    candidate: Candidate,
    data: Dataset,
    before: OpenLoopFit,
    *,
    iterations: int = 4,
    progress: Progress | None = None,
) -> OpenLoopFit:
    """The weights of the `candidate` of `before` once more, on another `model`. Strengths and what
    every error weighs stay; what is saved of the left-out errors counts from the model of
    `before`."""
    say = progress or (lambda _text, _share: None)
    with threadpool_limits(limits=1):
        paths = _paths(model, data)
        paths.scales = before.scales
        basis = Basis(model, candidate)
        cut = _Cut.of(paths, basis)
        parts = paths.all_normal(
            {"": basis}, cut.blocks, lambda text, share: say(text, 0.6 * share)
        )
        chosen = np.array([before.strengths[n] for n in candidate.outputs.names])
        found = _fitted(paths, basis, parts[""], chosen, cut, iterations, say)
    left, first = (np.sum(list(f.unseen.values())) for f in (found, before))
    return replace(found, held_out_gain=float(1 - (1 - before.held_out_gain) * left / first))


def _paths(model: IdentifiedModel, data: Dataset) -> Paths:
    """Predictions of the same times at every rate."""
    horizons, (stride,) = steps_ahead(model, HORIZONS), steps_ahead(model, (STRIDE,))
    return Paths(model, data, horizons=horizons, stride=stride)


def _fitted(
    paths: Paths,
    basis: Basis,
    parts: list[Normal],
    chosen: FloatArray,
    cut: _Cut,
    iterations: int,
    say: Progress,
) -> OpenLoopFit:
    """Weights with the strengths `chosen` (n_out,) from the normal equations `parts`, and what they
    make of kinds of flight left out."""
    factor = _dispersion(parts, cut.folds, basis, chosen)
    result, theta = _iterate(
        paths, basis, parts, chosen, factor, iterations, lambda text, s: say(text, 0.6 + 0.3 * s)
    )
    if result.status == "null":
        return result
    say("errors of kinds of flight left out", 0.9)
    unseen = _left_out(paths, basis, theta, chosen, cut)
    return replace(result, unseen=unseen, scales=paths.scales)


@dataclass(frozen=True, kw_only=True)
class _Cut:
    """How records are left out: the kind of flight of every record, and the blocks it is cut into.
    Of many flights a kind is left out whole, of few a block alone."""

    kinds: tuple[int, ...]
    blocks: int

    @classmethod
    def of(cls, paths: Paths, basis: Basis) -> _Cut:
        many = len({r.flight for r in paths.records}) >= FEW
        return cls(kinds=tuple(_kinds(paths, basis)), blocks=1 if many else BLOCKS)

    @cached_property
    def folds(self) -> list[list[int]]:
        """Blocks of all records, in order, that are left out together."""
        owners = [
            str(kind) if self.blocks == 1 else f"{i} {b}"
            for i, kind in enumerate(self.kinds)
            for b in range(self.blocks)
        ]
        return folds_of(owners)


def _kinds(paths: Paths, basis: Basis) -> list[int]:
    """Number of the kind of flight of every record: flights that cover the features alike are
    one kind.

    Mean and spread of every feature, clustered by average linkage into half as many kinds as
    flights (three at least); below `MANY` flights every flight is a kind of its own.
    """
    flights = list(dict.fromkeys(r.flight for r in paths.records))
    numbers = {f: i for i, f in enumerate(flights)}
    if len(flights) >= MANY:
        rows: dict[str, list[FloatArray]] = {f: [] for f in flights}
        for record in paths.records:
            _, at, states, _, _ = paths.errors(record)
            seen = evaluate(basis.look, states[at], paths.windows(record, at))
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
    return [numbers[r.flight] for r in paths.records]


def _judged_apart(
    paths: Paths,
    maker: Maker,
    found: dict[str, tuple[FloatArray, float]],
    cut: _Cut,
    strengths: Sequence[float],
    say: Progress,
) -> tuple[str, frozenset[str]]:
    """The best candidate that stands with features made without the flights that judge it, and
    those that promised something and were not asked, for a better one stands.

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
    hopeful = [label for label in order if np.isfinite(found[label][0]).any()]
    for asked, label in enumerate(hopeful, 1):
        chosen = found[label][0]
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
            return label, frozenset(hopeful[asked:])
    return order[0], frozenset()


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
    covariance, prior = _spread(
        alone(total(end.parts, "hessian"), basis.members, basis.m), end.theta, basis, chosen, factor
    )
    found = OpenLoopFit(
        posterior=fitted(basis.posterior, end.theta, covariance, prior),
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
) -> dict[str, FloatArray]:
    """Flight -> weighed squared errors (C,) with weights that have not seen its kind, in the
    quadratic model of the cost around the fit."""
    learned = np.isfinite(chosen)
    few, on = basis.only(learned), np.repeat(learned, basis.m)
    parts = [n for r in paths.records for n in paths.normal(r, [few], cut.blocks)[0]]
    flights = [r.flight for r in paths.records for _ in range(cut.blocks)]
    prior = np.repeat(chosen, basis.m)[on]
    whole_h, whole_g = total(parts, "hessian"), total(parts, "gradient")
    unseen: dict[str, FloatArray] = {}
    for fold in cut.folds:
        own = [parts[i] for i in fold]
        left_h, left_g = whole_h - total(own, "hessian"), whole_g - total(own, "gradient")
        d, _ = _newton(left_h, left_g, prior, theta[on], basis)
        for n, i in zip(own, fold, strict=True):
            after = n.cost + 2 * n.gradient @ d + (n.hessian @ d) @ d
            unseen[flights[i]] = unseen.get(flights[i], 0.0) + after
    return unseen


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


def _spread(
    hessian: FloatArray, theta: FloatArray, basis: Basis, chosen: FloatArray, factor: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """(covariance (P, P) of the weights theta (P,), their variance before the data (n_out,), zero
    of outputs that are off), from the Hessian (P, P) of the cost, the strengths `chosen` (n_out,)
    and the `factor` (n_out,) of `_dispersion`.

    A strength lambda suits weights of the variance factor/lambda. As the strongest wins that left-
    out flights bear, weights may be larger than that and are then shrunk by more than noise moves
    them. With their true variance tau^2 the mean square error is

        factor C H C + tau^2 lambda^2 C C,   C = (H + Lambda)^-1,

    and the expectation of |theta|^2 is factor tr(C H C) + tau^2 tr(C H H C), from which tau^2 of
    every group follows (empirical Bayes by moments); factor/lambda at least.
    """
    on = np.isfinite(chosen)
    free = np.repeat(on, basis.m)  # outputs that are off have no weights
    prior, noise = np.repeat(chosen[on], basis.m), np.repeat(factor[on], basis.m)
    h = hessian[np.ix_(free, free)]
    c = np.linalg.inv(h + np.diag(prior))
    seen = c @ h
    # Of an ensemble theta is that of the mean, a member's weights are as many times larger.
    size = (basis.members * theta[free]) ** 2 - np.einsum("ij,ji->i", seen, c) * noise
    names = basis.posterior.outputs.names
    groups = [n.split(".")[0] for n, o in zip(names, on, strict=True) if o]
    kinds = list(dict.fromkeys(groups))
    belongs = np.repeat([[g == k for k in kinds] for g in groups], basis.m, axis=0).astype(float)
    found, _ = scipy.optimize.nnls(belongs.T @ seen**2 @ belongs, np.maximum(size @ belongs, 0.0))
    before = np.zeros(on.size)
    before[on] = np.maximum([found[kinds.index(g)] for g in groups], (factor / chosen)[on])
    shrunk, root = c * (prior * np.sqrt(np.repeat(before[on], basis.m))), np.sqrt(noise)
    covariance = np.zeros_like(hessian)
    covariance[np.ix_(free, free)] = root[:, None] * (seen @ c) * root + shrunk @ shrunk.T
    return covariance, before
