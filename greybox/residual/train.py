"""Training of the residual GP: rows of inputs and outputs go in, a `GPPosterior` and a report come
out.

Hyper-parameters come from the exact marginal likelihood of a subset (greybox/residual/torch_gp.py),
the posterior then from all data in closed form (greybox/residual/sparse.py). On held-out samples,
by group and never by sample, every output has to beat a constant, and the number of support points
can be chosen there. PyTorch is imported only when training runs.
"""

from __future__ import annotations

import importlib.util
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np
import numpy.typing as npt
from threadpoolctl import threadpool_limits

from greybox.distribution import install_line
from greybox.errors import MissingExtraError, ModelError
from greybox.residual import sparse
from greybox.residual.inflation import autocorrelation_time, group_variances, groups_differ
from greybox.residual.judgement import judge, points_curve
from greybox.residual.kernels import Kernel
from greybox.residual.options import GPChoices, GPOptions
from greybox.residual.posterior import Domain, GPPosterior
from greybox.residual.selection import SIZES, Curve, held_out, place_points, stratified
from greybox.residual.training_report import OutputReport, TrainedGP, TrainingReport
from greybox.residual.training_rows import Rows, complete_rows
from greybox.symbolic import BoolArray, FloatArray, Layout

if TYPE_CHECKING:
    from greybox.residual.torch_gp import Hyper

Progress = Callable[[str, float], None]
"""Called with what is being done and the share of all work that is done."""
REACH = 1.5
"""The linear part is faded out from this multiple of the largest training input on."""
POLISH_SAMPLES = 2000


def check_extra() -> None:
    """Whether a GP can be trained here: asked before hours of other work, and without importing
    torch. Raises `MissingExtraError`."""
    missing = [n for n in ("torch", "gpytorch") if importlib.util.find_spec(n) is None]
    if missing:
        raise _missing(f"no {' and no '.join(missing)}")


def _missing(why: object) -> MissingExtraError:
    return MissingExtraError(
        f"training a GP needs PyTorch and GPyTorch ({why})", fix=install_line("gp")
    )


def _torch() -> Any:
    try:
        from greybox.residual import torch_gp
    except ImportError as error:
        raise _missing(error) from None
    return torch_gp


@dataclass(frozen=True, kw_only=True)
class _Output:
    """One trained output in standardised units."""

    hyper: Hyper
    numbers: sparse.Numbers | None
    noise: float
    tau: float
    guard: float
    by_group: dict[int, float]


@dataclass(frozen=True, kw_only=True)
class _Trained:
    posterior: GPPosterior
    outputs: tuple[_Output, ...]
    subset: int
    polish: str | None


def train_gp(
    Z: npt.ArrayLike,
    Y: npt.ArrayLike,
    *,
    inputs: Layout,
    outputs: Layout,
    options: GPOptions | None = None,
    groups: Sequence[Any] | npt.NDArray[Any] | None = None,
    progress: Progress | None = None,
    **choices: Unpack[GPChoices],
) -> TrainedGP:
    """Train one independent GP per output on rows Z (N, n_in) -> Y (N, n_out), in the units of the
    layouts.

    The choices are keywords, fields of `GPOptions` with its defaults, or `options` as a whole.
    groups (N,): the flight of each row, None for one flight; rows of a group are in time order.

    kernel: "se" (ARD), "matern32", "matern52", or "linear+" one of these. method: "sgpr" (all data
    projected on `points` support points), "svgp" (the same start, then `epochs` of mini-batches),
    "exact" (every sample a support point). points: a number, or "auto" for the smallest number
    whose held-out NLPD is as good as the best. noise: "white", "per-group", or "auto" (per group
    where the BIC says so). noise_inflation: "auto" (integrated autocorrelation time of the
    standardised errors within groups), or a factor. share_kernel: one kernel for all outputs, which
    is cheaper to evaluate. prior_mean: "zero" (what is far from the data is left to the physics) or
    "constant" (the training mean). subset: samples of the exact likelihood. hold_out: share of the
    samples, in whole groups, that judges whether the GP beats a constant; 0 for no judgement.
    polish: gradient polish of support points and hyper-parameters. guard: raise a sparse variance
    to the full GP's (`sparse.variance_guard`); else it is the posterior's own.

    Rows with a NaN are dropped and counted. Raises `ModelError` (shapes, too few rows),
    `UnknownNameError`, `FitError`, and `MissingExtraError` without the extra `gp`.
    """
    settings = GPOptions.of(options, choices)
    points, seed, hold_out = settings.points, settings.seed, settings.hold_out
    rows, names, dropped = complete_rows(Z, Y, groups, inputs, outputs)
    if points == "auto" and (settings.method == "exact" or hold_out <= 0):
        raise ModelError(
            'points="auto" needs a sparse method and a hold-out', fix="pass a number of points"
        )
    torch_gp = _torch()
    report = progress or (lambda _text, _share: None)
    seconds: dict[str, float] = {}
    warnings: list[str] = []
    constant = np.ptp(rows.z, axis=0) == 0
    if constant.any():
        warnings.append(
            "constant inputs say nothing: "
            f"{', '.join(n for n, c in zip(inputs.names, constant) if c)}"
        )
    with threadpool_limits(limits=1), torch_gp.one_thread():
        judged: dict[int, dict[str, float]] = {}
        start: list[Hyper] | None = None
        null = np.zeros(len(outputs), dtype=bool)
        curve: Curve | None = None
        out_names: tuple[str, ...] = ()
        if hold_out > 0:
            mask = held_out(rows.group, hold_out, seed)
            out_names = (
                tuple(names[g] for g in np.unique(rows.group[mask]))
                if len(names) > 1
                else ("last part",)
            )
            most = max(SIZES) if points == "auto" else int(points)
            tick = time.perf_counter()
            first = _train(
                rows.take(~mask),
                inputs,
                outputs,
                names,
                most,
                replace(settings, guard=False),
                None,
                null,
                report,
                (0.0, 0.5),
            )
            seconds["on the training part"] = time.perf_counter() - tick
            start = [o.hyper for o in first.outputs]
            judged, null = judge(first.posterior, rows.take(~mask), rows.take(mask))
            if points == "auto":
                tick = time.perf_counter()
                levels = [o.noise * o.tau for o in first.outputs]
                curve = points_curve(
                    first.posterior, levels, rows.take(~mask), rows.take(mask), null
                )
                seconds["curve"] = time.perf_counter() - tick
                points = curve.chosen if curve.trials else SIZES[0]
        tick = time.perf_counter()
        final = _train(
            rows, inputs, outputs, names, int(points), settings, start, null, report, (0.5, 1.0)
        )
        seconds["on all data"] = time.perf_counter() - tick
    posterior = final.posterior
    for name, is_null in zip(outputs.names, null):
        if is_null:
            warnings.append(
                f"{name}: the held-out samples do not prefer the GP to a constant; its mean is set "
                "to zero"
            )
    if final.polish == "diverged":
        warnings.append("the polish diverged; the result is without it")
    report("done", 1.0)
    return TrainedGP(
        posterior=posterior,
        report=TrainingReport(
            method=settings.method,
            kernel=settings.kernel,
            points=posterior.points,
            subset=final.subset,
            rows_used=len(rows.z),
            rows_dropped=dropped,
            groups=len(names),
            held_out=out_names,
            curve=curve,
            seconds=seconds,
            warnings=tuple(warnings),
            outputs=tuple(
                _report_output(posterior, j, o, bool(null[j]), judged.get(j, {}))
                for j, o in enumerate(final.outputs)
            ),
        ),
    )


def _train(
    rows: Rows,
    inputs: Layout,
    outputs: Layout,
    names: Sequence[str],
    points: int,
    s: GPOptions,
    start: Sequence[Hyper] | None,
    null: BoolArray,
    progress: Progress,
    share: tuple[float, float],
) -> _Trained:
    """Hyper-parameters on a subset, then the posterior from all of `rows`; statistics from these
    rows alone."""
    torch_gp = _torch()
    z_mean, z_scale = rows.z.mean(0), _scale(rows.z.std(0))
    y_mean = rows.y.mean(0) if s.prior_mean == "constant" else np.zeros(len(outputs))
    y_scale = _scale(np.sqrt(np.mean((rows.y - y_mean) ** 2, axis=0)))
    x, y = (rows.z - z_mean) / z_scale, (rows.y - y_mean) / y_scale
    reach = REACH * np.maximum(np.abs(x).max(0), 1.0)
    sub = (
        np.arange(len(x))
        if s.method == "exact" and len(x) <= s.subset
        else stratified(rows.group, s.subset, s.seed)
    )
    live = [j for j in range(len(outputs)) if not null[j]]
    hypers: dict[int, Hyper] = {}
    jobs = [live] if s.share_kernel and live else [[j] for j in live]
    span = share[1] - share[0]
    for i, job in enumerate(jobs):
        text = "all outputs" if s.share_kernel else outputs.names[job[0]]
        progress(f"hyper-parameters of {text}", share[0] + 0.8 * span * i / len(jobs))
        given = (
            None
            if start is None
            else replace(start[job[0]], noise=np.concatenate([start[j].noise for j in job]))
        )
        found = torch_gp.fit_hyper(
            x[sub],
            y[sub][:, job],
            kernel=s.kernel,
            reach=reach,
            seed=s.seed,
            restarts=s.restarts,
            start=given,
        )
        for at, j in enumerate(job):
            hypers[j] = replace(found, noise=found.noise[at : at + 1])
    kernels = {j: hypers[j].kernel for j in live}
    levels = {j: float(hypers[j].noise[0]) for j in live}
    support = x
    polished = None
    if s.method != "exact" and live:
        progress("support points", share[0] + 0.8 * span)
        noise = np.array([levels[j] for j in live])
        support = place_points(
            [kernels[j] for j in live], noise, x, points, seed=s.seed, group=rows.group
        )
        if s.polish:
            few = stratified(rows.group, POLISH_SAMPLES, s.seed + 1)
            new, noise, support, polished = torch_gp.polish(
                x[few], y[few][:, live], [kernels[j] for j in live], noise, support, iterations=100
            )
            kernels, levels = dict(zip(live, new)), dict(zip(live, noise.tolist()))
    elif not live:
        support = x[:1]
    done = []
    for j in range(len(outputs)):
        progress(
            f"posterior of {outputs.names[j]}", share[0] + span * (0.9 + 0.1 * j / len(outputs))
        )
        if null[j]:
            assert start is not None
            done.append(_null_output(start[j], float(np.mean(y[:, j] ** 2)), len(support)))
            continue
        done.append(
            _output(replace(hypers[j], kernel=kernels[j]), levels[j], support, x, y[:, j], rows, s)
        )
    flights = np.unique(rows.group)
    group_noise = {
        names[g]: np.array([o.by_group.get(int(g), o.noise) for o in done]) * y_scale**2
        for g in flights
        if any(o.by_group for o in done)
    }
    m = len(support)
    posterior = GPPosterior(
        inputs=inputs,
        outputs=outputs,
        method=s.method,
        kernels=tuple(o.hyper.kernel for o in done),
        input_mean=z_mean,
        input_scale=z_scale,
        output_mean=y_mean,
        output_scale=y_scale,
        support=support,
        weights=np.stack(
            [np.zeros(m) if o.numbers is None else o.numbers.weights for o in done], axis=1
        ),
        explained=np.stack(
            [np.zeros((m, m)) if o.numbers is None else o.numbers.explained for o in done]
        ),
        uncertain=np.stack(
            [np.zeros((m, m)) if o.numbers is None else o.numbers.uncertain for o in done]
        ),
        noise=np.array([o.noise for o in done]) * y_scale**2,
        group_noise=group_noise,
        noise_inflation=tuple(o.tau for o in done),
        variance_factor=tuple(o.guard for o in done),
        jitter=tuple(0.0 if o.numbers is None else o.numbers.jitter for o in done),
        domain=Domain(lower=rows.z.min(0), upper=rows.z.max(0), samples=len(x)),
    )
    seen = posterior.evaluate_distance(rows.z[stratified(rows.group, POLISH_SAMPLES, s.seed)])
    quantiles = np.quantile(seen, [0.5, 0.95, 0.99, 1.0])
    posterior = replace(posterior, domain=replace(posterior.domain, distance=tuple(quantiles)))
    return _Trained(posterior=posterior, outputs=tuple(done), subset=len(sub), polish=polished)


def _scale(values: FloatArray) -> FloatArray:
    return np.where(values > 0, values, 1.0)


def _null_output(hyper: Hyper, mean_square: float, points: int) -> _Output:
    """Zero mean; the kernel's variance is the leftover, at most what the data show, and the rest is
    noise."""
    kernel = hyper.kernel
    leftover = min(kernel.variance, mean_square)
    plain = Kernel(family=kernel.family, lengthscales=kernel.lengthscales, variance=leftover)
    return _Output(
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
    x: FloatArray,
    y: FloatArray,
    rows: Rows,
    s: GPOptions,
) -> _Output:
    """The posterior of one output from all rows, with its noise inflated for correlation in
    time."""
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
        kernel, noise, numbers, status = _torch().train_svgp(
            x, y, kernel, noise, support, tau=tau, seed=s.seed, epochs=s.epochs
        )
        hyper = replace(
            hyper, kernel=kernel, status=status if hyper.status == "converged" else hyper.status
        )
    guard = 1.0
    if s.method != "exact" and s.guard:
        guard = sparse.variance_guard(kernel, support.T, numbers, x.T, level * tau, seed=s.seed)
    return _Output(
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


def _report_output(
    posterior: GPPosterior, j: int, output: _Output, null: bool, scores: dict[str, float]
) -> OutputReport:
    hyper, scale = output.hyper, float(posterior.output_scale[j])
    return OutputReport(
        name=posterior.outputs.names[j],
        status="null" if null else hyper.status,
        message=hyper.message,
        log_likelihood=hyper.log_likelihood,
        evaluations=hyper.evaluations,
        at_bound=hyper.at_bound,
        lengthscales=tuple((hyper.kernel.lengthscales * posterior.input_scale).tolist()),
        signal_std=scale * math.sqrt(hyper.kernel.variance),
        noise_std=scale * math.sqrt(output.noise),
        noise_inflation=output.tau,
        noise_per_group=bool(output.by_group),
        **scores,
    )
