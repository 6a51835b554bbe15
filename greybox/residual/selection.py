"""Which samples stand for the others: support points, subsets, held-out groups, and how many
support points pay.

Everything here is deterministic by its seed. Inputs are standardised, samples are rows unless said
otherwise.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from typing import TypeVar

import numpy as np

from greybox.files import Json
from greybox.residual.kernels import Kernel
from greybox.symbolic import BoolArray, FloatArray, IntArray

Given = TypeVar("Given")
Result = TypeVar("Result")
CANDIDATES = 4000
"""Samples among which support points are looked for."""
SIZES = (10, 20, 30, 40, 50, 75, 100, 150, 200)
"""Numbers of support points that `points="auto"` tries."""
TOLERANCE = 0.01
"""Nats per sample by which the chosen number of points may be worse than the best."""


def stratified(group: IntArray, size: int, seed: int) -> IntArray:
    """`size` rows without replacement, each group in proportion to its length; all rows if there
    are no more."""
    n = len(group)
    if size >= n:
        return np.arange(n)
    rng = np.random.default_rng(seed)
    order = rng.permutation(n)
    # Sorting by (rank inside the group)/(group's length) interleaves the groups in proportion.
    rank = np.empty(n)
    for g in np.unique(group):
        rows = order[group[order] == g]
        rank[rows] = (np.arange(rows.size) + rng.uniform()) / rows.size
    return np.sort(np.argsort(rank, kind="stable")[:size])


def held_out(group: IntArray, share: float, seed: int) -> BoolArray:
    """Mask (N,) of held-out samples: whole groups, about `share` of them; with one group its last
    part in time."""
    names, sizes = np.unique(group, return_counts=True)
    mask = np.zeros(len(group), dtype=bool)
    if names.size == 1:
        mask[-max(1, round(share * len(group))) :] = True
        return mask
    order = np.random.default_rng(seed).permutation(names.size)
    total = 0
    for i in order[:-1]:
        mask |= group == names[i]
        total += int(sizes[i])
        if total >= share * len(group):
            break
    return mask


def place_points(
    kernels: Sequence[Kernel],
    noise: FloatArray,
    x: FloatArray,
    points: int,
    *,
    seed: int,
    group: IntArray | None = None,
) -> FloatArray:
    """Support points (M, n_in) for all outputs, the best first, so that every shorter list is its
    beginning.

    Greedy choice of the sample with the largest sum over outputs of (conditional variance given the
    points so far)/(noise variance): a pivoted Cholesky factorisation (Burt, Rasmussen and van der
    Wilk, JMLR 21, 2020, section 4), which works down the trace term of the Titsias bound. x (N,
    n_in); noise (n_out,). Fewer than `points` come back where the samples hold no more than that
    many different ones.
    """
    rows = stratified(
        np.zeros(len(x), dtype=np.int64) if group is None else group, CANDIDATES, seed
    )
    candidates = np.ascontiguousarray(x[rows].T)
    m = min(points, candidates.shape[1])
    unique = list({id(k): k for k in kernels}.values())
    # Outputs with a shared kernel act as one with the sum of their weights.
    weight = [sum(1.0 / noise[j] for j, k in enumerate(kernels) if k is u) for u in unique]
    left = [u.prior_variance(candidates).ravel().copy() for u in unique]
    prior = [v.copy() for v in left]
    columns = [np.zeros((m, candidates.shape[1])) for _ in unique]
    chosen: list[int] = []
    for step in range(m):
        gain = sum(w * v for w, v in zip(weight, left))
        best = int(np.argmax(gain))
        if all(v[best] <= 1e-10 * p[best] for v, p in zip(left, prior)):
            break
        chosen.append(best)
        for u, v, p, c in zip(unique, left, prior, columns):
            if v[best] <= 1e-10 * p[best]:
                v[best] = 0.0
                continue
            row = (
                u.covariance(candidates[:, [best]], candidates).ravel() - c[:step, best] @ c[:step]
            )
            c[step] = row / np.sqrt(v[best])
            v -= c[step] ** 2
            np.maximum(v, 0.0, out=v)
            v[best] = 0.0
    return np.ascontiguousarray(candidates[:, chosen].T)


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One number of support points: held-out NLPD (mean over samples and active outputs, nats), its
    standard error against the best trial, RMSE in training standard deviations, cost of one
    prediction of mean and variance."""

    points: int
    nlpd: float
    behind: float
    behind_error: float
    rmse: float
    flops: int
    seconds: float


@dataclass(frozen=True, kw_only=True)
class Curve:
    """Held-out quality against cost, and the number of points that it recommends."""

    trials: tuple[Trial, ...] = field(default_factory=tuple)
    chosen: int = 0

    def to_dict(self) -> dict[str, Json]:
        """Plain values."""
        return {"chosen": self.chosen, "trials": [asdict(t) for t in self.trials]}


def blocks_of(group: IntArray, at_least: int = 10) -> IntArray:
    """Block number of each held-out sample: the groups, or stretches of time where there are few
    groups."""
    names = np.unique(group)
    if names.size >= at_least:
        return np.searchsorted(names, group)
    per_group = -(-at_least // names.size)
    block = np.empty(len(group), dtype=np.int64)
    for i, g in enumerate(names):
        rows = np.flatnonzero(group == g)
        block[rows] = i * per_group + (np.arange(rows.size) * per_group) // rows.size
    return block


def mean_and_error(values: FloatArray, block: IntArray) -> tuple[float, float]:
    """Mean of values (N,) and its standard error from the spread of the block means."""
    means = np.array([values[block == b].mean() for b in np.unique(block)])
    error = float(means.std(ddof=1) / np.sqrt(means.size)) if means.size > 1 else float("inf")
    return float(values.mean()), error


def choose(
    sizes: Sequence[int],
    nlpd: Sequence[FloatArray],
    rmse: Sequence[float],
    block: IntArray,
    *,
    inputs: int,
    outputs: int,
    seconds: Sequence[float],
) -> Curve:
    """The smallest number of points whose NLPD is within one standard error (paired, by block), or
    `TOLERANCE`, of the best.

    `nlpd[i]` (N,) per held-out sample, averaged over outputs, for `sizes[i]` points.
    """
    best = int(np.argmin([float(v.mean()) for v in nlpd]))
    trials = []
    for i, m in enumerate(sizes):
        behind, error = mean_and_error(nlpd[i] - nlpd[best], block)
        flops = outputs * (2 * m * m + m * (2 * inputs + 6))
        trials.append(
            Trial(
                points=m,
                nlpd=float(nlpd[i].mean()),
                behind=behind,
                behind_error=0.0 if i == best else error,
                rmse=rmse[i],
                flops=flops,
                seconds=seconds[i],
            )
        )
    good = [t.points for t in trials if t.behind <= max(t.behind_error, TOLERANCE)]
    return Curve(trials=tuple(trials), chosen=min(good))


def timed(call: Callable[[Given], Result], given: Given) -> tuple[Result, float]:
    """(result, seconds)."""
    start = time.perf_counter()
    result = call(given)
    return result, time.perf_counter() - start
