"""Regret: what the best numbers for new data gain on numbers that are integrated over what is known,
to second order."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


def projected(
    h: FloatArray, g: FloatArray, places: Sequence[int], rest: Sequence[int]
) -> tuple[FloatArray, FloatArray]:
    """Information (k, k) on the unknowns at `places` and their score (k,), those at `rest`
    integrated out, of the information `h` (n, n) and the gradient `g` (n,) of all: the Schur
    complement (Rao 1948), in which directions of the others without information count as nothing."""
    scale = np.sqrt(np.maximum(np.diag(h), 1e-300))
    unit, slope = h / np.outer(scale, scale), g / scale
    own, score = unit[np.ix_(places, places)], slope[places]
    if len(rest):
        cross = unit[np.ix_(places, rest)]
        moved = np.linalg.pinv(unit[np.ix_(rest, rest)], rcond=1e-12, hermitian=True) @ cross.T
        own, score = own - cross @ moved, score - slope[rest] @ moved
    return np.asarray(own * np.outer(scale[places], scale[places])), score * scale[places]


def information_on(h: FloatArray, places: Sequence[int], rest: Sequence[int]) -> FloatArray:
    """The information of `projected` alone."""
    return projected(h, np.zeros(len(h)), places, rest)[0]


def regret(v: FloatArray, theta: FloatArray, v1: FloatArray, theta1: FloatArray) -> float:
    """Log of the supremum over D2 less that of the integral over what D1 taught, of unknowns with
    information `v1` (k, k) and estimates `theta1` (k,) from D1 and `v`, `theta` from both:

        log det(V) / 2 - log det(V1) / 2 + d' V1 d / 2 + (V1 d)' (V - V1)^-1 (V1 d) / 2,

    d what D2 moved the estimate by; at least 0.
    """
    d = v1 @ (theta - theta1)
    _, large = np.linalg.slogdet(v)
    _, small = np.linalg.slogdet(v1)
    level, directions = np.linalg.eigh(v - v1)
    keep = level > 1e-9 * max(level.max(initial=0.0), 1e-300)
    along = directions[:, keep].T @ d
    ends = float((theta - theta1) @ d) + float((along**2 / level[keep]).sum())
    return max(0.5 * float(large - small) + 0.5 * ends, 0.0)
