"""Exact log marginal likelihood of a Gaussian process with its gradient, in closed form.

    -log p(y) = y'K^-1 y/2 + log|K|/2 + N log(2 pi)/2,   d/dK = (K^-1 - a a')/2 with a = K^-1 y

(Rasmussen and Williams 2006, eq. 5.9). The value is GPyTorch's; what automatic differentiation
carries along for it is most of its time at a few hundred rows.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg

from greybox.errors import FitError
from greybox.residual.kernels import Kernel, correlation
from greybox.symbolic import FloatArray


class MarginalLikelihood:
    """Minus log marginal likelihood of the columns of y (N, n) at standardised inputs x (N, n_in)
    under one kernel, each column with a noise of its own."""

    def __init__(self, x: FloatArray, y: FloatArray) -> None:
        self._x, self._y = np.ascontiguousarray(x), y

    def value(self, kernel: Kernel, noise: FloatArray) -> tuple[float, FloatArray]:
        """(sum over columns, gradient) for noise variances (n,); the gradient is that in the
        logarithms of length-scales, variance, slopes (where there are any) and noises.

        Raises `FitError` where a covariance has no Cholesky factor.
        """
        u = self._x / kernel.lengthscales
        norm = (u * u).sum(axis=1)
        square = norm[:, None] + norm - 2.0 * (u @ u.T)
        c, g = correlation(kernel.family, square, np)
        covariance = kernel.variance * c
        linear = None
        if kernel.slopes is not None:
            linear = kernel.features(self._x.T).T
            covariance = covariance + (linear * kernel.slopes) @ linear.T
        total, weight, noises = 0.0, np.zeros_like(c), np.zeros(len(noise))
        for j, level in enumerate(noise):
            cost, own = _column(covariance, self._y[:, j], float(level))
            total, weight = total + cost, weight + own
            noises[j] = level * np.trace(own)
        g *= weight
        # sum_ij T_ij (u_i - u_j)^2 for a symmetric T.
        apart = 2.0 * (g.sum(axis=1) @ (u * u) - (u * (g @ u)).sum(axis=0))
        parts = [-2.0 * kernel.variance * apart, [kernel.variance * float(np.vdot(weight, c))]]
        if linear is not None:
            parts.append(kernel.slopes * (linear * (weight @ linear)).sum(axis=0))
        return total, np.concatenate([*parts, noises])


def _column(covariance: FloatArray, y: FloatArray, noise: float) -> tuple[float, FloatArray]:
    """(minus log likelihood of y (N,), its slope (N, N) in the covariance) with that noise
    variance."""
    matrix = covariance.copy()
    matrix.flat[:: len(y) + 1] += noise
    try:
        # The transpose is the same matrix as LAPACK keeps it.
        factor = scipy.linalg.cholesky(matrix.T, lower=True, overwrite_a=True, check_finite=False)
    except np.linalg.LinAlgError as error:
        raise FitError("a covariance matrix has no Cholesky factor") from error
    logs = float(np.log(np.diag(factor)).sum())
    half, failed = scipy.linalg.lapack.dpotri(factor, lower=1, overwrite_c=1)
    if failed:
        raise FitError("a covariance matrix has no inverse")
    inverse = np.tril(half)
    inverse = inverse + np.tril(inverse, -1).T
    a = inverse @ y
    cost = 0.5 * float(y @ a) + logs + 0.5 * len(y) * np.log(2.0 * np.pi)
    return cost, 0.5 * (inverse - np.outer(a, a))
