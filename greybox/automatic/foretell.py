"""How well a model foretells pieces of the training flights that were left out, in one number with
a standard error.

The score of a block of origins is the mean, over channel groups and horizons, of the squared error
ahead in units of the mean squared error of holding the last value: below one is better than doing
nothing. Two models are compared block by block, so that a rough piece counts against neither.
(Hastie, Tibshirani and Friedman 2009, The Elements of Statistical Learning, sec. 7.10: the
one-standard-error rule.)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from greybox.data import Dataset, Segment
from greybox.estimation.filtering import Filter
from greybox.model.identified import IdentifiedModel
from greybox.symbolic import FloatArray
from greybox.validation.baselines import persistence
from greybox.validation.groups import GROUPS, error_norms
from greybox.validation.horizon import strided
from greybox.validation.open_loop import GroupReader, IntArray, predict_from

HORIZONS = (0.1, 0.5)
"""Seconds ahead that count: what an attitude and a position controller look ahead."""
BLOCK = 2.0
"""Length of a block [s]: errors of origins that are closer share what caused them."""
FEWEST = 4
"""Blocks that short pieces are cut into where they are long enough: of fewer no scatter is seen."""
SPACING = 0.05
"""Seconds between origins: neighbours tell the same."""
SETTLE = 1.0
"""Seconds at the start of a piece in which the filter finds its state."""
LEAST = (2.5 * HORIZONS[-1] + SPACING) / 0.75
"""Length of a piece [s] below which it has no two blocks, so that no score has an error: a quarter
settles where it is short, and a block and a half of the longest horizon come before that."""
WORST = 100.0
"""Score of a block whose prediction is not finite: a hundred times worse than doing nothing."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Score:
    """`blocks` (n,): score of every block, in the same order for all models on the same pieces; NaN
    where a block has nothing to be compared with."""

    blocks: FloatArray

    @property
    def mean(self) -> float:
        """Mean over the blocks; 1 = holding the last value."""
        known = self.blocks[np.isfinite(self.blocks)]
        return float(known.mean()) if known.size else float("inf")

    def better_by(self, other: Score) -> tuple[float, float]:
        """(how much lower this score is than `other`, standard error of that), from paired
        blocks."""
        gain = other.blocks - self.blocks
        gain = gain[np.isfinite(gain)]
        if gain.size < 2:
            return float(gain.sum()), float("inf")
        return float(gain.mean()), float(gain.std(ddof=1) / np.sqrt(gain.size))


def foretell(model: IdentifiedModel, pieces: Dataset, *, use_compiler: bool = True) -> Score:
    """Score of `model` on `pieces`, each with the parameters of its flight where the model has
    them.

    Raises `DataError`, `FitError` where the model cannot run on them.
    """
    runner = Filter(model, use_compiler=use_compiler)
    reader = GroupReader(model)
    groups = reader.judged(pieces.any_channels)
    dt = model.sample_time
    steps = [max(1, round(h / dt)) for h in HORIZONS]
    longest = steps[-1]
    own: list[FloatArray] = []
    held: list[FloatArray] = []
    labels: list[IntArray] = []
    count = 0
    every = [_origins(s, groups, dt, longest) for s in pieces.segments]
    seconds = sum(float(o[-1] - o[0]) * dt for o in every if o.size)
    length = min(BLOCK, max(HORIZONS[-1], seconds / FEWEST))
    for flight in pieces:
        for segment in flight.segments:
            origins = _origins(segment, groups, dt, longest)
            if origins.size == 0:
                continue
            run = runner.run(segment.without(flight.noncausal), p=model.flight_vector(flight.name))
            ahead = predict_from(runner.engine, reader, run, origins, steps=longest)
            errors, naive = _squared_errors(segment, ahead, groups, origins, steps)
            own.append(errors)
            held.append(naive)
            block = _blocks((origins - origins[0]) * dt, length)
            labels.append(count + block)
            count += int(block[-1]) + 1
    if not own:
        return Score(blocks=np.zeros(0))
    shares, label = _shares(np.concatenate(own), np.concatenate(held)), np.concatenate(labels)
    blocks = [shares[label == b] for b in range(count)]
    return Score(
        blocks=np.array([np.nanmean(b) if np.isfinite(b).any() else np.nan for b in blocks])
    )


def _squared_errors(
    segment: Segment,
    ahead: Mapping[str, FloatArray],
    groups: Sequence[str],
    origins: IntArray,
    steps: Sequence[int],
) -> tuple[FloatArray, FloatArray]:
    """Squared errors (origins, groups, steps) of the predictions `ahead` of a segment, infinite
    where they are not finite, and those of holding the last value; NaN where nothing was measured."""
    references = {
        g: segment.matrix(GROUPS[g].columns)
        for g in groups
        if set(GROUPS[g].columns) <= set(segment.names)
    }
    last = persistence(references, origins, steps=steps[-1])
    own, held = np.full((2, origins.size, len(groups), len(steps)), np.nan)
    for j, g in enumerate(groups):
        if g not in references:
            continue
        for k, h in enumerate(steps):
            truth = references[g][origins + h]
            with np.errstate(over="ignore", invalid="ignore"):
                e = error_norms(g, _safe(ahead[g][:, h - 1]), truth)
            lost = np.isfinite(truth).all(axis=1) & ~np.isfinite(e)
            own[:, j, k] = np.where(lost, np.inf, e**2)
            held[:, j, k] = error_norms(g, last[g][:, h - 1], truth) ** 2
    return own, held


def _blocks(time: FloatArray, length: float) -> IntArray:
    """Number of the block of every time [s] since the first; a short rest joins the block before."""
    last = max(0, round(float(time[-1]) / length) - 1)
    return np.minimum((time // length).astype(int), last)


def _shares(error: FloatArray, held: FloatArray) -> FloatArray:
    """Squared errors in units of the mean of those of holding the last value, `WORST` at most."""
    # A group that is slower than the origins are apart may have no last value that far ahead.
    known = np.isfinite(held).sum(axis=0)
    scale = np.nansum(held, axis=0) / np.where(known > 0, known, np.nan)
    return np.minimum(error / np.maximum(scale, 1e-300), WORST)


def _origins(segment: Segment, groups: Sequence[str], dt: float, longest: int) -> IntArray:
    """Samples from which is foretold, spread where a reference is slower than the rows."""
    settle, every = min(round(SETTLE / dt), segment.n // 4), max(1, round(SPACING / dt))
    rows = np.arange(settle, segment.n - longest - 1)
    measured = [GROUPS[g].columns for g in groups if set(GROUPS[g].columns) <= set(segment.names)]
    return strided(rows, every, map(segment.matrix, measured))


def _safe(predicted: FloatArray) -> FloatArray:
    """Predictions that are not finite as missing."""
    out = np.array(predicted, dtype=np.float64)
    out[~np.isfinite(out).all(axis=1) | (np.abs(out) > 1e6).any(axis=1)] = np.nan
    return out
