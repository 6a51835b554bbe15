"""Held-out judgement of a trained GP: does it beat a constant, and how many support points does it
need?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from greybox.residual import sparse
from greybox.residual.posterior import GPPosterior
from greybox.residual.selection import (
    SIZES,
    Curve,
    IntArray,
    blocks_of,
    choose,
    mean_and_error,
    timed,
)
from greybox.residual.training_rows import Rows
from greybox.symbolic import BoolArray, FloatArray

JUDGED = 10_000
"""Held-out samples that judge at most."""
CHANCE = 0.04
"""Probability that a GP which foretells nothing passes for better than the constant."""
FLIPS = 4096
"""Random signs that stand for all of them where there are more than twelve blocks."""


def _nlpd(y: FloatArray, mean: FloatArray | float, variance: FloatArray | float) -> FloatArray:
    return 0.5 * (np.log(2.0 * np.pi * variance) + (y - mean) ** 2 / variance)


def _rms(errors: FloatArray) -> float:
    return float(np.sqrt(np.mean(errors**2)))


def _thin(rows: Rows) -> Rows:
    return rows.take(slice(None, None, -(-len(rows.z) // JUDGED)))


def better_by_chance(gain: FloatArray, block: IntArray) -> float:
    """Probability that gains (N,) without a preference would come out as good, judged by their
    means over `block` (N,).

    Share of all signs of the block means whose sum is at least the observed one (Fisher's paired
    randomisation test, The Design of Experiments, 1935, section 21). A standard error would refuse
    a gain that sits in few blocks, such as that of ground effect in a record that flies low twice,
    however large it is.
    """
    names, counts = np.unique(block, return_counts=True)
    means = np.array([gain[block == b].mean() for b in names]) * counts
    if means.size <= 12:
        signs = 1.0 - 2.0 * ((np.arange(2**means.size)[:, None] >> np.arange(means.size)) & 1)
    else:
        signs = np.random.default_rng(0).choice([-1.0, 1.0], (FLIPS, means.size))
        signs[0] = 1.0
    total = float(means.sum())
    return float(np.mean(signs @ means >= total - 1e-9 * np.abs(means).sum()))


def judge(
    posterior: GPPosterior, train: Rows, test: Rows
) -> tuple[dict[int, dict[str, float]], BoolArray]:
    """(held-out scores by output, mask (n_out,) of the outputs that lose against the constant of
    the training part).

    An output keeps its GP only if its NLPD is better than chance would have it
    (`better_by_chance`).
    """
    test = _thin(test)
    mean, variance = posterior.evaluate(test.z, noise=True)
    block = blocks_of(test.group)
    scores: dict[int, dict[str, float]] = {}
    null = np.zeros(test.y.shape[1], dtype=bool)
    for j in range(test.y.shape[1]):
        y, centre = test.y[:, j], float(posterior.output_mean[j])
        level = float(np.mean((train.y[:, j] - centre) ** 2))
        if level == 0:
            null[j] = True
            continue
        gp, flat = _nlpd(y, mean[:, j], variance[:, j]), _nlpd(y, centre, level)
        gain, error = mean_and_error(flat - gp, block)
        null[j] = better_by_chance(flat - gp, block) > CHANCE
        scores[j] = {
            "nlpd": float(gp.mean()),
            "nlpd_constant": float(flat.mean()),
            "gain": gain,
            "gain_error": error,
            "rmse": _rms(y - mean[:, j]),
            "rmse_constant": _rms(y - centre),
        }
    return scores, null


def points_curve(
    full: GPPosterior, noise: Sequence[float], train: Rows, test: Rows, null: BoolArray
) -> Curve:
    """Held-out quality for the beginnings of the list of support points of `full`, all else held.

    noise (n_out,): the noise variance, inflation included, in standardised units. Outputs in `null`
    do not count; a curve without trials comes back where none is left.
    """
    test = _thin(test)
    live = np.flatnonzero(~null)
    if live.size == 0:
        return Curve()
    x = (train.z - full.input_mean) / full.input_scale
    y = (train.y - full.output_mean) / full.output_scale
    sizes = sorted({m for m in SIZES if m < full.points} | {full.points})
    nlpd, rmse, seconds = [], [], []
    for m in sizes:
        support = full.support[:m]
        numbers = [
            sparse.collapsed(kernel, support.T, x.T, y[:, j], noise[j])
            for j, kernel in enumerate(full.kernels)
        ]
        posterior = replace(
            full,
            support=support,
            weights=np.stack([n.weights for n in numbers], axis=1),
            explained=np.stack([n.explained for n in numbers]),
            uncertain=np.stack([n.uncertain for n in numbers]),
            jitter=tuple(n.jitter for n in numbers),
        )
        posterior.evaluate(test.z[:2])  # builds the function, which is not what is timed
        (mean, variance), taken = timed(posterior.evaluate, test.z)
        nlpd.append(_nlpd(test.y, mean, variance + posterior.noise)[:, live].mean(1))
        rmse.append(_rms(((test.y - mean) / full.output_scale)[:, live]))
        seconds.append(taken / len(test.z))
    return choose(
        sizes,
        nlpd,
        rmse,
        blocks_of(test.group),
        inputs=x.shape[1],
        outputs=live.size,
        seconds=seconds,
    )
