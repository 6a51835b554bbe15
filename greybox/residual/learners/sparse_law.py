"""A sparse law: few terms out of a library of polynomials, chosen by thresholded least squares.

Terms 1, x_i, x_i x_j and x_i |x_i| of the inputs in units of their spread (no mean is taken out:
zero stays zero); coefficients below a threshold are dropped and the rest fitted again, until
nothing changes (Brunton, Proctor and Kutz 2016, PNAS 113(15)). The terms that stay are the
features; several thresholds compete on left-out flights.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence

import casadi as ca
import numpy as np

from greybox.residual.learners.learner import Features
from greybox.statistics.spread import spread_of
from greybox.symbolic import Expr, FloatArray

THRESHOLDS = (0.05, 0.15, 0.4)
"""Least coefficients, in spreads of the output per spread of the term."""
ROUNDS = 10
Term = Callable[[Sequence[Expr]], Expr]
"""A term of a list of inputs, arrays or expressions alike."""


class SparseLaw:
    """Thresholded least squares over a library of terms."""

    name = "sparse"
    centred = False
    """Inputs are scaled but not shifted."""

    def features(
        self, x: FloatArray, y: FloatArray, *, points: int, seed: int
    ) -> Mapping[str, Features]:
        """One candidate per threshold."""
        terms = _library(x.shape[1])
        columns = np.stack([np.asarray(t(list(x.T))) * np.ones(len(x)) for t in terms], axis=1)
        spread = spread_of(columns)
        out: dict[str, Features] = {}
        for threshold in THRESHOLDS:
            kept = _kept(columns / spread, y, threshold, points)
            if kept:
                out[f"law, threshold {threshold:g}"] = _law(
                    [terms[i] for i in kept], spread[list(kept)]
                )
        return out


def _library(n: int) -> list[Term]:
    """All terms of n inputs."""
    pairs = itertools.combinations_with_replacement(range(n), 2)
    return [
        _one,
        *(_power(i) for i in range(n)),
        *(_power(i, j) for i, j in pairs),
        *(_drag(i) for i in range(n)),
    ]


def _one(x: Sequence[Expr]) -> Expr:
    return 0 * x[0] + 1.0


def _power(*which: int) -> Term:
    return lambda x: math.prod(x[i] for i in which)


def _drag(i: int) -> Term:
    """x_i |x_i|, smooth at zero."""
    return lambda x: x[i] * (x[i] * x[i] + 1e-6) ** 0.5


def _kept(columns: FloatArray, y: FloatArray, threshold: float, most: int) -> tuple[int, ...]:
    """Places of the terms that stay for any output."""
    union: set[int] = set()
    for target in y.T:
        at = np.arange(columns.shape[1])
        for _ in range(ROUNDS):
            w = np.linalg.lstsq(columns[:, at], target, rcond=None)[0]
            big = np.abs(w) >= threshold
            if big.all() or not big.any():
                break
            at = at[big]
        w = np.linalg.lstsq(columns[:, at], target, rcond=None)[0]
        strong = at[np.abs(w) >= threshold]
        union |= set(strong[np.argsort(-np.abs(w[np.abs(w) >= threshold]))][:most].tolist())
    return tuple(sorted(union))


def _law(terms: list[Term], spread: FloatArray) -> Features:
    def phi(s: Expr) -> Expr:
        parts = ca.vertsplit(s)
        return ca.vertcat(*(t(parts) / float(d) for t, d in zip(terms, spread, strict=True)))

    return phi
