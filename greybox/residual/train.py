"""Training of the residual GP: rows of inputs and outputs go in, a `GPPosterior` and a report come
out.

Hyper-parameters come from the exact marginal likelihood of a subset
(greybox/residual/hyper_parameters.py), the posterior then from all data in closed form
(greybox/residual/sparse.py); one training is in greybox/residual/training_run.py. On held-out
samples, by group and never by sample, every output has to beat a constant, and the number of
support points can be chosen there. PyTorch is imported only where points are polished, and for
SVGP.
"""

from __future__ import annotations

import importlib.util
import math
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from typing import Unpack

import numpy as np
import numpy.typing as npt
from threadpoolctl import threadpool_limits

from greybox.distribution import install_line
from greybox.errors import MissingExtraError, ModelError
from greybox.residual.judgement import judge, points_curve
from greybox.residual.options import GPChoices, GPOptions
from greybox.residual.posterior import GPPosterior
from greybox.residual.selection import SIZES, Curve, held_out
from greybox.residual.training_report import OutputReport, TrainedGP, TrainingReport
from greybox.residual.training_rows import Groups, Rows, complete_rows
from greybox.residual.training_run import Progress, Start, Task, Trained, TrainedOutput, train
from greybox.symbolic import BoolArray, Layout


def check_extra() -> None:
    """Whether what needs PyTorch can run here, asked without importing it: polish of support points,
    svgp. Raises `MissingExtraError`."""
    missing = [n for n in ("torch", "gpytorch") if importlib.util.find_spec(n) is None]
    if missing:
        raise _missing(f"no {' and no '.join(missing)}")


def _missing(why: object) -> MissingExtraError:
    return MissingExtraError(
        f"svgp and polish need PyTorch and GPyTorch ({why})", fix=install_line("gp")
    )


def _one_thread(options: GPOptions) -> AbstractContextManager[None]:
    """PyTorch on one thread, where it takes part. Raises `MissingExtraError`."""
    if not options.polish and options.method != "svgp":
        return nullcontext()
    check_extra()
    try:
        from greybox.residual.torch_gp import one_thread
    except ImportError as error:
        raise _missing(error) from None
    return one_thread()


def train_gp(
    Z: npt.ArrayLike,
    Y: npt.ArrayLike,
    *,
    inputs: Layout,
    outputs: Layout,
    options: GPOptions | None = None,
    groups: Groups | None = None,
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
    `UnknownNameError`, `FitError`; svgp and polish `MissingExtraError` without the extra `gp`.
    """
    settings = GPOptions.of(options, choices)
    rows, names, dropped = complete_rows(Z, Y, groups, inputs, outputs)
    if settings.points == "auto" and (settings.method == "exact" or settings.hold_out <= 0):
        raise ModelError(
            'points="auto" needs a sparse method and a hold-out', fix="pass a number of points"
        )
    one_thread = _one_thread(settings)
    report = progress or (lambda _text, _share: None)
    task = Task(inputs=inputs, outputs=outputs, flights=names, options=settings, progress=report)
    with threadpool_limits(limits=1), one_thread:
        judged = _judged(task, rows) if settings.hold_out > 0 else None
        points = settings.points if judged is None else judged.points
        start = None if judged is None else judged.start
        tick = time.perf_counter()
        final = train(_within(task, 0.5, 1.0), rows, int(points), start)
        seconds = {} if judged is None else judged.seconds
        seconds = {**seconds, "on all data": time.perf_counter() - tick}
    report("done", 1.0)
    return TrainedGP(
        posterior=final.posterior,
        report=replace(_report(task, rows, final, judged), rows_dropped=dropped, seconds=seconds),
    )


@dataclass(frozen=True, kw_only=True)
class _Judged:
    """What the held-out samples say: where the training on all rows starts, the scores by output,
    the number of support points, and the flights that judged."""

    start: Start
    scores: dict[int, dict[str, float]]
    points: int
    curve: Curve | None
    flights: tuple[str, ...]
    seconds: dict[str, float]


def _report(task: Task, rows: Rows, final: Trained, judged: _Judged | None) -> TrainingReport:
    """What the training on `rows` did, without its times and without the rows that were
    dropped."""
    null = np.zeros(len(task.outputs), dtype=bool) if judged is None else judged.start.constant
    scores = {} if judged is None else judged.scores
    return TrainingReport(
        method=task.options.method,
        kernel=task.options.kernel,
        points=final.posterior.points,
        subset=final.subset,
        rows_used=len(rows.z),
        rows_dropped=0,
        groups=len(task.flights),
        held_out=() if judged is None else judged.flights,
        curve=None if judged is None else judged.curve,
        warnings=tuple(_warnings(task, rows, final, null)),
        outputs=tuple(
            _report_output(final.posterior, j, o, bool(null[j]), scores.get(j, {}))
            for j, o in enumerate(final.outputs)
        ),
    )


def _judged(task: Task, rows: Rows) -> _Judged:
    """Train without the held-out samples, and judge by them."""
    o = task.options
    mask = held_out(rows.group, o.hold_out, o.seed)
    kept, left_out = rows.take(~mask), rows.take(mask)
    points = max(SIZES) if o.points == "auto" else int(o.points)
    tick = time.perf_counter()
    first = train(replace(_within(task, 0.0, 0.5), options=replace(o, guard=False)), kept, points)
    seconds = {"on the training part": time.perf_counter() - tick}
    scores, constant = judge(first.posterior, kept, left_out)
    curve: Curve | None = None
    if o.points == "auto":
        tick = time.perf_counter()
        levels = [output.noise * output.tau for output in first.outputs]
        curve = points_curve(first.posterior, levels, kept, left_out, constant)
        seconds["curve"] = time.perf_counter() - tick
        points = curve.chosen if curve.trials else SIZES[0]
    several = len(task.flights) > 1
    return _Judged(
        start=Start(hypers=[output.hyper for output in first.outputs], constant=constant),
        scores=scores,
        points=points,
        curve=curve,
        flights=tuple(task.flights[g] for g in np.unique(left_out.group))
        if several
        else ("last part",),
        seconds=seconds,
    )


def _within(task: Task, begin: float, end: float) -> Task:
    """The task as a part of a longer one: its progress goes from `begin` to `end` of it."""
    hear = task.progress
    return replace(task, progress=lambda text, share: hear(text, begin + (end - begin) * share))


def _warnings(task: Task, rows: Rows, final: Trained, null: BoolArray) -> Iterator[str]:
    constant = np.ptp(rows.z, axis=0) == 0
    if constant.any():
        idle = ", ".join(n for n, c in zip(task.inputs.names, constant) if c)
        yield f"constant inputs say nothing: {idle}"
    for name, is_null in zip(task.outputs.names, null):
        if is_null:
            yield (
                f"{name}: the held-out samples do not prefer the GP to a constant; its mean is set "
                "to zero"
            )
    if final.polish == "diverged":
        yield "the polish diverged; the result is without it"


def _report_output(
    posterior: GPPosterior, j: int, output: TrainedOutput, null: bool, scores: dict[str, float]
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
