"""How strong the prior of a learned part is: chosen on kinds of flight that its weights did not
see.

Everything happens in the quadratic model of the multi-step cost around zero weights, from the
normal equations of stretches of flight. Where the features themselves were made from flights (a
network, a law), they are made again without the judged ones (`Maker`): features that have seen what
they foretell foretell it anyhow.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy.linalg

from greybox.residual.judgement import CHANCE
from greybox.residual.weight_space import Candidate, alone
from greybox.statistics.distributions import student_quantile
from greybox.symbolic import BoolArray, FloatArray
from greybox.validation.against import TRACE

HARM = 1e-4
"""Share by which a choice may raise the left-out errors of a channel group (rounding, not harm)."""


class Maker(Protocol):
    """Makes candidates again from some of the rows that they were made of."""

    @property
    def flights(self) -> tuple[str, ...]:
        """Flight of every row, rows of a flight in order of time."""

    def again(self, label: str, rows: BoolArray) -> Candidate | None:
        """The candidate of this name from `rows` (N,); None where they offer none."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Normal:
    """Normal equations of a stretch of flight by channel group (rate, rotation, ...): cost (C,),
    gradient g (C, P) and Gauss-Newton Hessian h (C, P, P) in theta."""

    cost: FloatArray
    gradient: FloatArray
    hessian: FloatArray


@dataclass(frozen=True, kw_only=True, eq=False)
class Judged:
    """One left-out fold: Hessian (P, P) and gradient (P,) of all other stretches, its own by channel
    group, and its `cost` (C,) without a learned part."""

    left_hessian: FloatArray
    left_gradient: FloatArray
    hessian: FloatArray
    gradient: FloatArray
    cost: FloatArray


def total(parts: Sequence[Normal], what: str) -> FloatArray:
    """Sum over stretches and channel groups."""
    return np.asarray(np.sum([getattr(n, what).sum(axis=0) for n in parts], axis=0))


def by_channel(parts: Sequence[Normal], what: str) -> FloatArray:
    """Sum over stretches, channel groups apart."""
    return np.asarray(np.sum([getattr(n, what) for n in parts], axis=0))


def folds_of(owners: Sequence[str]) -> list[list[int]]:
    """Which parts are left out together: those of one owner (a kind of flight; a stretch, where
    there are few flights)."""
    return [[i for i, o in enumerate(owners) if o == n] for n in dict.fromkeys(owners)]


def judged(parts: Sequence[Normal], folds: Sequence[Sequence[int]]) -> list[Judged]:
    """Each of the `folds` left out of all `parts`."""
    whole_h, whole_g = total(parts, "hessian"), total(parts, "gradient")
    out = []
    for fold in folds:
        own = [parts[i] for i in fold]
        h, g = by_channel(own, "hessian"), by_channel(own, "gradient")
        out.append(
            Judged(
                left_hessian=whole_h - h.sum(axis=0),
                left_gradient=whole_g - g.sum(axis=0),
                hessian=h,
                gradient=g,
                cost=by_channel(own, "cost"),
            )
        )
    return out


def choose(
    found: Sequence[Judged],
    cost: FloatArray,
    outputs: Sequence[str],
    strengths: Sequence[float],
    members: int = 1,
) -> tuple[FloatArray, float]:
    """Prior strength per output by leaving kinds of flight out, in the quadratic model of the cost;
    share of it saved.

    `cost` (C,) of the channel groups without a learned part. Outputs of a group (force, torque)
    share one strength. A choice must not raise the left-out errors of any channel group, whatever
    it saves elsewhere. Among choices within one standard error of the best the strongest prior
    wins; all are switched off where what it saves is not `worth` learning. Of an ensemble of
    `members` it is the mean that is judged.
    """
    groups = [n.split(".")[0] for n in outputs]
    kinds = list(dict.fromkeys(groups))
    choices = list(itertools.product(strengths, repeat=len(kinds)))
    every = np.array([[c[kinds.index(g)] for g in groups] for c in choices])
    saved = np.stack([_saved(fold, every, len(cost), members) for fold in found], axis=1)
    by_group = {c: s for c, s in zip(choices, saved) if harmless(s, cost)}
    results = {c: s.sum(axis=1) for c, s in by_group.items()}
    best = max(results, key=lambda c: float(results[c].sum()))
    margin = results[best]
    keep = [
        c
        for c, saved in results.items()
        if (margin - saved).sum() <= np.sqrt(len(found)) * (margin - saved).std(ddof=1) + 1e-12
    ]
    strongest = max(
        keep, key=lambda c: (sum(np.log10(min(v, 1e6)) for v in c), float(results[c].sum()))
    )
    if not worth(by_group[strongest], np.array([fold.cost for fold in found])):
        return np.full(len(groups), np.inf), 0.0
    share = float(results[strongest].sum() / cost.sum())
    return np.array([strongest[kinds.index(g)] for g in groups]), share


def harmless(saved: FloatArray, cost: FloatArray) -> bool:
    """Whether what a choice saves (F, C), fold by fold, raises the cost (C,) of no channel group."""
    return bool((saved.sum(axis=0) >= -HARM * cost).all())


def worth(saved: FloatArray, cost: FloatArray) -> bool:
    """Whether what a choice saves (F, C) of the costs (F, C) of the channel groups, fold by fold, is
    worth learning: more than a trace of the squared errors of some group, and in sum more than
    chance would have it.

    Student's test of the share that is saved, a ratio over folds of unequal size (W. G. Cochran,
    "Sampling Techniques", 1977, section 6.3). Two folds tell no chance: each has to gain.
    """
    gained, whole, folds = saved.sum(axis=1), cost.sum(axis=1), len(saved)
    if not (saved.sum(axis=0) > TRACE * cost.sum(axis=0)).any():
        return False
    if folds < 3:
        return bool((gained > 0).all())
    off = gained - gained.sum() / whole.sum() * whole
    chance = np.sqrt(folds / (folds - 1) * (off @ off))
    return bool(gained.sum() > float(student_quantile(1 - CHANCE, folds - 1)) * chance)


def _saved(fold: Judged, every: FloatArray, channels: int, members: int) -> FloatArray:
    """What `every` choice of strengths (n, n_out) saves of the costs of a left-out fold, (n,
    `channels`)."""
    out = np.zeros((len(every), channels))
    # Features that are made again without some flights may be more or fewer: terms of a law, for
    # one.
    features = fold.left_gradient.size // every.shape[1]
    left = alone(fold.left_hessian, members, features)
    silent, pattern = np.unique(np.isinf(every), axis=0, return_inverse=True)
    for k, off in enumerate(silent):
        if off.all():
            continue
        on = np.repeat(~off, features)
        at = np.ix_(on, on)
        block, slope = left[at], fold.left_gradient[on]
        gradient, hessian = fold.gradient[:, on], fold.hessian[:, on][:, :, on]
        for i in np.flatnonzero(pattern.ravel() == k):
            prior = np.repeat(every[i], features)[on]
            theta = -_solved(block, prior, slope) / members
            out[i] = -(2 * gradient @ theta + hessian @ theta @ theta)
    return out


def _solved(hessian: FloatArray, prior: FloatArray, slope: FloatArray) -> FloatArray:
    """(H + diag(prior))^-1 slope for a Hessian (P, P); by Cholesky, where rounding leaves it
    positive definite."""
    try:
        found = scipy.linalg.cho_solve(
            # The transpose is the same matrix as LAPACK keeps it, so that it is factored in place.
            scipy.linalg.cho_factor(
                _loaded(hessian, prior).T, lower=True, overwrite_a=True, check_finite=False
            ),
            slope,
            check_finite=False,
        )
    except np.linalg.LinAlgError:
        found = np.linalg.solve(_loaded(hessian, prior), slope)
    return np.asarray(found, dtype=np.float64)


def _loaded(hessian: FloatArray, prior: FloatArray) -> FloatArray:
    """H + diag(prior)."""
    matrix = hessian.copy()
    matrix.flat[:: len(matrix) + 1] += prior
    return matrix


@dataclass(frozen=True, kw_only=True, eq=False)
class Halves:
    """The flights in two halves: `of_part` says the half of every part, `rows` (2, N) the rows of a
    maker by half."""

    of_part: list[int]
    rows: BoolArray

    @classmethod
    def of(
        cls,
        flights: Sequence[str],
        kinds: Mapping[str, int],
        blocks: int,
        lengths: Sequence[int],
        rows: Sequence[str],
    ) -> Halves:
        """Kinds of flight in turn into one half and the other; a single flight is cut in the
        middle.

        `flights` and `lengths`: name and samples of every record, each of which is `blocks` parts.
        """
        if len(kinds) > 1:
            order = {k: i % 2 for i, k in enumerate(dict.fromkeys(kinds.values()))}
            side = {f: order[k] for f, k in kinds.items()}
            of_part = [side[f] for f in flights for _ in range(blocks)]
            first = np.array([side.get(f, 0) == 0 for f in rows])
        else:
            begins = np.cumsum([0, *lengths])
            middle = begins[-1] / 2
            of_part = [
                int(begin + n * (b + 0.5) / blocks > middle)
                for begin, n in zip(begins, lengths, strict=False)
                for b in range(blocks)
            ]
            first = np.arange(len(rows)) < len(rows) / 2
        return cls(of_part=of_part, rows=np.stack([first, ~first]))

    def judged(
        self, parts: Sequence[Sequence[Normal]], folds: Sequence[Sequence[int]]
    ) -> list[Judged]:
        """`parts[h]` are of features made from half h: every fold is judged by those that were not
        made from it."""
        both = [judged(own, folds) for own in parts]
        return [both[1 - self.of_part[fold[0]]][i] for i, fold in enumerate(folds)]
