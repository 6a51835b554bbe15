"""How much an output residual helps: one-step scores and open-loop errors per channel, with and
without it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypedDict

import numpy as np

from greybox.baselines.base_predictor import BasePredictor
from greybox.baselines.compare_scores import SPACING, StepScores, one_step_scores
from greybox.baselines.output_residual import OutputHybrid
from greybox.data import Dataset, Segment
from greybox.errors import DataError
from greybox.linear.validation import RUN_IN
from greybox.symbolic import BoolArray, FloatArray
from greybox.validation.horizon import spread_origins
from greybox.validation.predictive import score

Ahead = tuple[FloatArray, FloatArray, FloatArray]
"""Measured values (m, n_o), their means and variances foretold."""


class ChannelAhead(TypedDict):
    """Errors of one channel, and how far their stated spread holds."""

    rmse: float
    unit: str
    nlpd: float
    coverage95: float
    n: int


class HorizonScores(TypedDict):
    """Errors h samples ahead, by channel."""

    h: int
    seconds: float
    channels: dict[str, ChannelAhead]


class Judged(TypedDict):
    """One predictor, one step and further ahead."""

    one_step: StepScores
    horizons: list[HorizonScores]


class BothJudged(TypedDict):
    """The base model, and the same with what was learned."""

    before: Judged
    after: Judged


def judge(
    hybrid: OutputHybrid, data: Dataset, *, spread: FloatArray, horizons: Sequence[int]
) -> BothJudged:
    """ "before" (the base model) and "after" (with its Gaussian process) on the flights of `data`,
     on the same samples.

    Each has `one_step` (as `one_step_scores`, standardised by `spread` (n_o,)) and `horizons`: {h,
    seconds, channels: {name: {rmse, nlpd, coverage95, n, unit}}}. Raises `DataError` where the
    flights are too short.
    """
    base = hybrid.base
    rows = [_judged(hybrid, s) for s in data.segments]
    units = [base.dynamics.outputs.signals[base.dynamics.outputs[n]].unit for n in base.outputs]
    late = [(s, r) for s, r in zip(data.segments, rows, strict=True) if r.any()]
    if not late:
        raise DataError(
            "no flight is long enough to judge the model on",
            fix="longer flights, or fewer --adapt seconds",
        )
    found: list[Judged] = []
    for predictor in (base, hybrid):
        told = [predictor.one_step(s) for s, _ in late]
        ahead = _ahead(predictor, late, horizons)
        scored = one_step_scores(
            [s.matrix(base.outputs)[r] for s, r in late],
            [mean[r] for (_, r), (mean, _) in zip(late, told, strict=True)],
            [variance[r] for (_, r), (_, variance) in zip(late, told, strict=True)],
            [s.matrix(base.commands)[r] for s, r in late],
            names=base.outputs,
            units=units,
            spread=spread,
            dt=base.dt,
        )
        found.append(
            {
                "one_step": scored,
                "horizons": [
                    {
                        "h": h,
                        "seconds": float(f"{h * base.dt:.9g}"),
                        "channels": {
                            n: _cell(parts, i, units[i]) for i, n in enumerate(base.outputs)
                        },
                    }
                    for h, parts in ahead.items()
                    if parts
                ],
            }
        )
    before, after = found
    return {"before": before, "after": after}


def _ahead(
    predictor: BasePredictor | OutputHybrid,
    late: Sequence[tuple[Segment, BoolArray]],
    horizons: Sequence[int],
) -> dict[int, list[Ahead]]:
    """Horizon [samples] -> what was measured and foretold, segment by segment."""
    found: dict[int, list[Ahead]] = {h: [] for h in horizons}
    longest = max(horizons)
    for segment, rows in late:
        origins = np.flatnonzero(rows)
        every = max(1, round(SPACING / segment.dt))
        origins = spread_origins(origins[origins < segment.n - longest], every)
        if origins.size:
            y = segment.matrix(predictor.outputs)
            far, spread = predictor.free_run(segment, origins, longest)
            for h in horizons:
                found[h].append((y[origins + h], far[:, h - 1], spread[:, h - 1]))
    return found


def _judged(hybrid: OutputHybrid, segment: Segment) -> BoolArray:
    """Samples (n,) that both predict, once a linear model has forgotten its start."""
    mean, _ = hybrid.one_step(segment)
    late = np.asarray(np.isfinite(mean).all(axis=1))
    if hybrid.base.adapt is None:
        late[: min(round(RUN_IN / segment.dt), segment.n // 3)] = False
    return late


def _cell(parts: Sequence[Ahead], i: int, unit: str) -> ChannelAhead:
    y, mean, variance = (np.concatenate([p[k][:, i] for p in parts]) for k in range(3))
    seen = score(y, mean, variance)
    return {
        "rmse": seen.mse**0.5,
        "unit": unit,
        "nlpd": seen.nlpd,
        "coverage95": seen.coverage[0.95],
        "n": seen.n,
    }
