"""Burst: effects that are felt in a few stretches of the flights, which the metric of block scores can hardly see.

In that metric a statistic cannot exceed the number of blocks in which the effect is felt, however large it is: the same
blocks make up the sum and its spread. A pass over the ground is felt in two or three. Where the information on a candidate
(not its scores, which are what is tested) lies in few blocks, Fisher's metric is taken instead, divided by the
overdispersion that the scores of the other candidates show there: innovations that are correlated in time spread the
scores of all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from greybox.estimation.problem import Block
from greybox.symbolic import FloatArray

FEW = 24.0
"""Blocks below which this is asked. With n of them the statistic of a large effect comes to about n, and chi^2 must be above
13 (one degree of freedom) or 20 (three) to be the largest of thirty by chance in one log of twenty."""


def information(blocks: Sequence[Block], directions: FloatArray, samples: int) -> FloatArray:
    """What stretches of `samples` samples of predictions with sensitivities tell of `directions` (n unknowns, k),
    (n_stretches, k)."""
    rows = []
    for b in blocks:
        assert b.jacobian is not None
        assert b.covariance is not None
        n, along = len(b.e), directions[b.columns]
        told = np.zeros((n, along.shape[1]))
        for g, covariance in enumerate(b.covariance):
            at = np.flatnonzero(b.pattern == g)
            if at.size:
                inverse = np.linalg.inv(np.linalg.cholesky(covariance))
                told[at] = (np.matmul(inverse @ b.jacobian[at], along) ** 2).sum(axis=1)
        rows.append(np.add.reduceat(told, np.arange(0, n, samples), axis=0))
    return np.concatenate(rows)


def effective_blocks(told: FloatArray, shares: FloatArray) -> float:
    """In how many blocks the information on one candidate lies, if they were equal: (sum I)^2 / sum I^2, its directions
    (n_blocks, k) weighted by their `shares` of the whole."""
    each = (told / shares).sum(axis=1)
    return float(each.sum() ** 2 / max((each**2).sum(), 1e-300))


def overdispersion(blocks: Mapping[str, FloatArray], shares: Mapping[str, FloatArray]) -> float:
    """How much the block scores (n_blocks, k) of candidates spread over what their information promises: the median over all
    directions, at least 1."""
    ratios = [((b - b.mean(axis=0)) ** 2).sum(axis=0) / shares[n] for n, b in blocks.items()]
    return max(1.0, float(np.median(np.concatenate(ratios)))) if ratios else 1.0
