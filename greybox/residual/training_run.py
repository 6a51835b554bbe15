"""One training of a GP from rows: hyper-parameters on a subset, support points, then the posterior
of every output from all rows.

Statistics are those of these rows alone. What is held out, and what it decides, is the business of
greybox/residual/train.py.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from greybox.residual import sparse
from greybox.residual.hyper_parameters import Hyper, fit_hyper
from greybox.residual.inflation import autocorrelation_time, group_variances, groups_differ
from greybox.residual.kernels import Kernel
from greybox.residual.options import GPOptions
from greybox.residual.posterior import Domain, GPPosterior
from greybox.residual.selection import IntArray, place_points, stratified
from greybox.residual.training_rows import Rows
from greybox.statistics.spread import spread_of
from greybox.symbolic import BoolArray, FloatArray, Layout

Progress = Callable[[str, float], None]
"""Called with what is being done and the share of all work that is done."""
REACH = 1.5
"""The linear part is faded out from this multiple of the largest training input on."""
POLISH_SAMPLES = 2000


@dataclass(frozen=True, kw_only=True)
class Task:
    """What is trained: the layouts of inputs and outputs, the flight of each number of a group, the
    choices, and who hears of it."""

    inputs: Layout
    outputs: Layout
    flights: Sequence[str]
    options: GPOptions
    progress: Progress


@dataclass(frozen=True, kw_only=True)
class TrainedOutput:
    """One trained output in standardised units; `numbers` is None for a constant."""

    hyper: Hyper
    numbers: sparse.Numbers | None
    noise: float
    tau: float
    guard: float
    by_group: dict[int, float]


@dataclass(frozen=True, kw_only=True)
class Trained:
    """The posterior, its outputs, the samples of the exact likelihood and how the polish ended."""

    posterior: GPPosterior
    outputs: tuple[TrainedOutput, ...]
    subset: int
    polish: str | None


@dataclass(frozen=True, kw_only=True)
class Start:
    """Where hyper-parameters begin, and which outputs (n_out,) are a constant: both from an earlier
    training, on the part of the rows that is not held out."""

    hypers: Sequence[Hyper]
    constant: BoolArray


@dataclass(frozen=True, kw_only=True)
class _Standardised:
    """Rows of zero mean and unit spread: inputs x (N, n_in), outputs y (N, n_out)."""

    x: FloatArray
    y: FloatArray
    input_mean: FloatArray
    input_scale: FloatArray
    output_mean: FloatArray
    output_scale: FloatArray

    @classmethod
    def of(cls, rows: Rows, prior_mean: str) -> _Standardised:
        z_mean, z_scale = rows.z.mean(0), spread_of(rows.z)
        y_mean = rows.y.mean(0) if prior_mean == "constant" else np.zeros(rows.y.shape[1])
        y_scale = spread_of(rows.y) if prior_mean == "constant" else _size(rows.y)
        return cls(
            x=(rows.z - z_mean) / z_scale,
            y=(rows.y - y_mean) / y_scale,
            input_mean=z_mean,
            input_scale=z_scale,
            output_mean=y_mean,
            output_scale=y_scale,
        )


@dataclass(frozen=True, kw_only=True)
class _Support:
    """Support points (M, n_in), with the kernels and noise variances of the outputs that are
    learned."""

    points: FloatArray
    kernels: dict[int, Kernel]
    levels: dict[int, float]
    polish: str | None = None


def train(task: Task, rows: Rows, points: int, start: Start | None = None) -> Trained:
    """Train all outputs on `rows` with `points` support points."""
    o, count = task.options, len(task.outputs)
    data = _Standardised.of(rows, o.prior_mean)
    constant = np.zeros(count, dtype=bool) if start is None else start.constant
    live = [j for j in range(count) if not constant[j]]
    subset = (
        np.arange(len(data.x))
        if o.method == "exact" and len(data.x) <= o.subset
        else stratified(rows.group, o.subset, o.seed)
    )
    hypers = _hyper_parameters(task, data, subset, live, start)
    support = _support(task, data, rows.group, points, hypers)
    done = []
    for j in range(count):
        task.progress(f"posterior of {task.outputs.names[j]}", 0.9 + 0.1 * j / count)
        if constant[j]:
            assert start is not None
            mean_square = float(np.mean(data.y[:, j] ** 2))
            done.append(_null_output(start.hypers[j], mean_square))
            continue
        hyper = replace(hypers[j], kernel=support.kernels[j])
        done.append(_output(hyper, support.levels[j], support.points, data, j, rows, o))
    posterior = _posterior(task, data, rows, support.points, done)
    return Trained(
        posterior=posterior, outputs=tuple(done), subset=len(subset), polish=support.polish
    )


def _hyper_parameters(
    task: Task, data: _Standardised, subset: IntArray, live: Sequence[int], start: Start | None
) -> dict[int, Hyper]:
    """Of the outputs `live`, by the exact marginal likelihood of the rows `subset`."""
    o = task.options
    reach = REACH * np.maximum(np.abs(data.x).max(0), 1.0)
    hypers: dict[int, Hyper] = {}
    jobs = [live] if o.share_kernel and live else [[j] for j in live]
    for i, job in enumerate(jobs):
        text = "all outputs" if o.share_kernel else task.outputs.names[job[0]]
        task.progress(f"hyper-parameters of {text}", 0.8 * i / len(jobs))
        given = None
        if start is not None:
            noise = np.concatenate([start.hypers[j].noise for j in job])
            given = replace(start.hypers[job[0]], noise=noise)
        found = fit_hyper(
            data.x[subset],
            data.y[subset][:, job],
            kernel=o.kernel,
            reach=reach,
            seed=o.seed,
            restarts=o.restarts,
            start=given,
        )
        for at, j in enumerate(job):
            hypers[j] = replace(found, noise=found.noise[at : at + 1])
    return hypers


def _support(
    task: Task, data: _Standardised, group: IntArray, points: int, hypers: dict[int, Hyper]
) -> _Support:
    """Support points for the outputs with `hypers`, by `place_points` and a polish where wanted."""
    o, live = task.options, list(hypers)
    kernels = {j: hypers[j].kernel for j in live}
    levels = {j: float(hypers[j].noise[0]) for j in live}
    if not live:
        return _Support(points=data.x[:1], kernels=kernels, levels=levels)
    if o.method == "exact":
        return _Support(points=data.x, kernels=kernels, levels=levels)
    task.progress("support points", 0.8)
    noise = np.array([levels[j] for j in live])
    placed = place_points(
        [kernels[j] for j in live], noise, data.x, points, seed=o.seed, group=group
    )
    if not o.polish:
        return _Support(points=placed, kernels=kernels, levels=levels)
    from greybox.residual.torch_gp import polish

    few = stratified(group, POLISH_SAMPLES, o.seed + 1)
    new, noise, placed, status = polish(
        data.x[few],
        data.y[few][:, live],
        [kernels[j] for j in live],
        noise,
        placed,
        iterations=100,
    )
    return _Support(
        points=placed,
        kernels=dict(zip(live, new)),
        levels=dict(zip(live, noise.tolist())),
        polish=status,
    )


def _posterior(
    task: Task,
    data: _Standardised,
    rows: Rows,
    support: FloatArray,
    outputs: Sequence[TrainedOutput],
) -> GPPosterior:
    """The outputs as one posterior in the units of the layouts, with the domain of the rows."""
    group_noise = {
        task.flights[g]: np.array([o.by_group.get(int(g), o.noise) for o in outputs])
        * data.output_scale**2
        for g in np.unique(rows.group)
        if any(o.by_group for o in outputs)
    }
    m = len(support)
    posterior = GPPosterior(
        inputs=task.inputs,
        outputs=task.outputs,
        method=task.options.method,
        kernels=tuple(o.hyper.kernel for o in outputs),
        input_mean=data.input_mean,
        input_scale=data.input_scale,
        output_mean=data.output_mean,
        output_scale=data.output_scale,
        support=support,
        weights=np.stack(
            [np.zeros(m) if o.numbers is None else o.numbers.weights for o in outputs], axis=1
        ),
        explained=np.stack(
            [np.zeros((m, m)) if o.numbers is None else o.numbers.explained for o in outputs]
        ),
        uncertain=np.stack(
            [np.zeros((m, m)) if o.numbers is None else o.numbers.uncertain for o in outputs]
        ),
        noise=np.array([o.noise for o in outputs]) * data.output_scale**2,
        group_noise=group_noise,
        noise_inflation=tuple(o.tau for o in outputs),
        variance_factor=tuple(o.guard for o in outputs),
        jitter=tuple(0.0 if o.numbers is None else o.numbers.jitter for o in outputs),
        domain=Domain(lower=rows.z.min(0), upper=rows.z.max(0), samples=len(rows.z)),
    )
    some = stratified(rows.group, POLISH_SAMPLES, task.options.seed)
    quantiles = np.quantile(posterior.evaluate_distance(rows.z[some]), [0.5, 0.95, 0.99, 1.0])
    return replace(posterior, domain=replace(posterior.domain, distance=tuple(quantiles)))


def _size(values: FloatArray) -> FloatArray:
    """Root mean square of every column, 1 of one that is zero."""
    size = np.sqrt(np.mean(values**2, axis=0))
    return np.where(size > 0, size, 1.0)


def _null_output(hyper: Hyper, mean_square: float) -> TrainedOutput:
    """Zero mean; the kernel's variance is the leftover, at most what the data show, and the rest is
    noise."""
    kernel = hyper.kernel
    leftover = min(kernel.variance, mean_square)
    plain = Kernel(family=kernel.family, lengthscales=kernel.lengthscales, variance=leftover)
    return TrainedOutput(
        hyper=replace(hyper, kernel=plain),
        numbers=None,
        noise=mean_square - leftover,
        tau=1.0,
        guard=1.0,
        by_group={},
    )


def _output(
    hyper: Hyper,
    noise: float,
    support: FloatArray,
    data: _Standardised,
    j: int,
    rows: Rows,
    s: GPOptions,
) -> TrainedOutput:
    """The posterior of output j from all rows, with its noise inflated for correlation in time."""
    x, y = data.x, data.y[:, j]
    kernel = hyper.kernel
    tau = 1.0 if s.noise_inflation == "auto" else float(s.noise_inflation)
    level: FloatArray | float = noise
    by_group: dict[int, float] = {}
    numbers = _closed(kernel, support, x, y, level, tau, s.method)
    per_group = s.noise == "per-group"
    # The errors depend a little on the inflation, and it on them: three rounds settle it.
    for _ in range(3):
        e = y - _mean_at(kernel, support, x, numbers.weights)
        before = tau
        spread = np.sqrt(level)
        if s.noise_inflation == "auto":
            tau = autocorrelation_time(e / spread, rows.place, rows.group)
        if s.noise == "auto" and not per_group:
            per_group = groups_differ(e, rows.group, tau)
        if per_group:
            by_group = group_variances(e, rows.group)
            level = np.array([by_group[g] for g in rows.group.tolist()])
        elif abs(tau - before) <= 0.02 * before:
            break
        numbers = _closed(kernel, support, x, y, level, tau, s.method)
    if by_group:
        noise = float(np.mean(list(by_group.values())))
    if s.method == "svgp":
        from greybox.residual.torch_gp import train_svgp

        kernel, noise, numbers, status = train_svgp(
            x, y, kernel, noise, support, tau=tau, seed=s.seed, epochs=s.epochs
        )
        hyper = replace(
            hyper, kernel=kernel, status=status if hyper.status == "converged" else hyper.status
        )
    guard = 1.0
    if s.method != "exact" and s.guard:
        guard = sparse.variance_guard(kernel, support.T, numbers, x.T, level * tau, seed=s.seed)
    return TrainedOutput(
        hyper=hyper, numbers=numbers, noise=noise, tau=tau, guard=guard, by_group=by_group
    )


def _closed(
    kernel: Kernel,
    support: FloatArray,
    x: FloatArray,
    y: FloatArray,
    level: FloatArray | float,
    tau: float,
    method: str,
) -> sparse.Numbers:
    if method == "exact":
        return sparse.exact(kernel, x.T, y, level * tau)
    return sparse.collapsed(kernel, support.T, x.T, y, level * tau)


def _mean_at(kernel: Kernel, support: FloatArray, x: FloatArray, weights: FloatArray) -> FloatArray:
    parts = [
        weights @ kernel.covariance(support.T, x[at : at + sparse.CHUNK].T)
        for at in range(0, len(x), sparse.CHUNK)
    ]
    return np.concatenate(parts)
