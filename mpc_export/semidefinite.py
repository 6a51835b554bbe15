"""Matrices that are positive semidefinite by what they mean: covariances and costs.

Rounding may leave them an eigenvalue below zero of any size that their largest one allows, so none
is helped by a fixed addition to the diagonal: what is below zero is zero.
"""

from __future__ import annotations

import numpy as np

from greybox.symbolic import FloatArray


def positive(m: FloatArray) -> FloatArray:
    """The nearest positive semidefinite matrix (n, n) to m (Higham 1988, Linear Algebra and its
    Applications 103)."""
    root = half(m)
    return np.asarray(root @ root.T)


def half(m: FloatArray) -> FloatArray:
    """R (n, n) with R R' the nearest positive semidefinite matrix to m."""
    if not m.size:
        return np.zeros_like(m, dtype=float)
    values, vectors = np.linalg.eigh(0.5 * (m + m.T))
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def upper_half(m: FloatArray) -> FloatArray:
    """U (n, n) without a number below the diagonal, U' U the nearest positive semidefinite matrix
    to m: Cholesky's where m is positive definite."""
    upper = np.linalg.qr(half(m).T, mode="r")
    signs = np.where(np.diag(upper) < 0, -1.0, 1.0)
    return np.asarray(signs[:, None] * upper)
