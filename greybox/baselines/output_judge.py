"""How much an output residual helps: one-step scores and open-loop errors per channel, with and
without it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypedDict

import numpy as np

from greybox.baselines.base_predictor import RUN_IN
from greybox.baselines.compare_scores import SPACING, StepScores, one_step_scores
from greybox.baselines.output_residual import OutputHybrid
from greybox.data import Dataset, Segment
from greybox.errors import DataError
from greybox.symbolic import BoolArray, FloatArray
from greybox.validation.predictive import score


class HorizonScores(TypedDict):
    """Errors h samples ahead: channel -> rmse, unit, nlpd, coverage95, n."""

    h: int
    seconds: float
    channels: dict[str, dict[str, float | str]]


class Judged(TypedDict):
    """One predictor, one step and further ahead."""

    one_step: StepScores
    horizons: list[HorizonScores]


def judge(
    hybrid: OutputHybrid, data: Dataset, *, spread: FloatArray, horizons: Sequence[int]
) -> dict[str, Judged]:
    """ "before" (the base model) and "after" (with its Gaussian process) on the flights of `data`,
     on the same samples.

    Each has `one_step` (as `one_step_scores`, standardised by `spread` (n_o,)) and `horizons`: {h,
    seconds, channels: {name: {rmse, nlpd, coverage95, n, unit}}}. Raises `DataError` where the
    flights are too short.
    """
    base = hybrid.base
    rows = [_judged(hybrid, s) for s in data.segments]
    longest = max(horizons)
    units = [base.dynamics.outputs.signals[base.dynamics.outputs[n]].unit for n in base.outputs]
    out: dict[str, Judged] = {}
    for label, predictor in (("before", base), ("after", hybrid)):
        measured, means, variances, inputs = [], [], [], []
        ahead: dict[int, list[tuple[FloatArray, FloatArray, FloatArray]]] = {
            h: [] for h in horizons
        }
        for segment, late in zip(data.segments, rows, strict=True):
            if not late.any():
                continue
            y = segment.matrix(base.outputs)
            mean, variance = predictor.one_step(segment)
            measured.append(y[late])
            means.append(mean[late])
            variances.append(variance[late])
            inputs.append(segment.matrix(base.commands)[late])
            origins = np.flatnonzero(late)
            origins = origins[origins < segment.n - longest][:: max(1, round(SPACING / segment.dt))]
            if origins.size:
                far, spread_ahead = predictor.free_run(segment, origins, longest)
                for h in horizons:
                    ahead[h].append((y[origins + h], far[:, h - 1], spread_ahead[:, h - 1]))
        if not measured:
            raise DataError(
                "no flight is long enough to judge the model on",
                fix="longer flights, or fewer --adapt seconds",
            )
        scored = one_step_scores(
            measured,
            means,
            variances,
            inputs,
            names=base.outputs,
            units=units,
            spread=spread,
            dt=base.dt,
        )
        out[label] = {
            "one_step": scored,
            "horizons": [
                {
                    "h": h,
                    "seconds": float(f"{h * base.dt:.9g}"),
                    "channels": {n: _cell(parts, i, units[i]) for i, n in enumerate(base.outputs)},
                }
                for h, parts in ahead.items()
                if parts
            ],
        }
    return out


def _judged(hybrid: OutputHybrid, segment: Segment) -> BoolArray:
    """Samples (n,) that both predict, once a linear model has forgotten its start."""
    mean, _ = hybrid.one_step(segment)
    late = np.asarray(np.isfinite(mean).all(axis=1))
    if hybrid.base.adapt is None:
        late[: min(round(RUN_IN / segment.dt), segment.n // 3)] = False
    return late


def _cell(
    parts: Sequence[tuple[FloatArray, FloatArray, FloatArray]], i: int, unit: str
) -> dict[str, float | str]:
    y, mean, variance = (np.concatenate([p[k][:, i] for p in parts]) for k in range(3))
    seen = score(y, mean, variance)
    return {
        "rmse": seen.mse**0.5,
        "unit": unit,
        "nlpd": seen.nlpd,
        "coverage95": seen.coverage[0.95],
        "n": seen.n,
    }
