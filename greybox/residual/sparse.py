"""Posteriors in closed form: hyper-parameters and data go in, the numbers of a predictor come out.
NumPy and SciPy only.

Every posterior has one form, with L1 = `explained` and L2 = `uncertain` (both lower triangular, M x
M, inverses already taken, so that a prediction is matrix products):

    mean(x) = w'k(x),    variance(x) = [k(x, x) - |L1 k(x)|^2] + |L2 k(x)|^2,    k(x) = k(Z, x).

The bracket is a conditional prior variance and cannot be negative but for rounding, which is cut
off at zero; the last term is a sum of squares. Samples are columns, (n_in, N); inputs and outputs
are standardised and the prior mean is zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky, qr, solve_triangular

from greybox.errors import FitError
from greybox.residual.kernels import Kernel
from greybox.symbolic import FloatArray

CHUNK = 8192
"""Samples whose covariances are held in memory at once."""
GUARD_SAMPLES = 3000
"""Samples whose exact posterior judges the variance of a sparse one."""
PROBES = 1000
JITTERS = (0.0, 1e-10, 1e-9, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4)
"""Shares of the mean diagonal that are added to it in turn until the Cholesky factorisation
exists."""
LEAST = 1e-10
"""Least such share of a covariance of support points: a factor may exist without it whose inverse
has entries of 1e7 and more, which multiply the rounding of 1 - |L1 k|^2."""


@dataclass(frozen=True, kw_only=True)
class Numbers:
    """weights (M,), explained and uncertain (M, M) lower triangular, the jitter added to the
    diagonal of K(Z, Z), and the log marginal likelihood of the data (of a sparse posterior: of its
    approximate prior, or without correction the lower bound; None where it is not known)."""

    weights: FloatArray
    explained: FloatArray
    uncertain: FloatArray
    jitter: float
    log_likelihood: float | None


def safe_cholesky(matrix: FloatArray, jitter: float | None = None) -> tuple[FloatArray, float]:
    """(lower factor, jitter that was added to the diagonal). With `jitter` that one and no other is
    tried.

    Raises `FitError` where even the largest of `JITTERS` does not help.
    """
    level = float(np.mean(np.diag(matrix)))
    for added in (jitter,) if jitter is not None else [share * level for share in JITTERS]:
        try:
            return cholesky(matrix + added * np.eye(len(matrix)), lower=True), float(added)
        except (np.linalg.LinAlgError, ValueError):
            continue
    raise FitError(
        "a covariance matrix has no Cholesky factor",
        got=f"{len(matrix)} points, mean variance {level:.3g}",
        fix="fewer support points, or look for infinite or huge inputs",
    )


def support_factor(
    kernel: Kernel, support: FloatArray, jitter: float | None = None
) -> tuple[FloatArray, float]:
    """(lower factor of the covariance of support points (n_in, M), jitter on its diagonal: a share
    `LEAST` of the variance at least), so that its inverse may be multiplied with. With `jitter`
    that one. Raises `FitError` as `safe_cholesky`."""
    matrix = kernel.covariance(support, support)
    if jitter is not None:
        return safe_cholesky(matrix, jitter)
    least = LEAST * float(np.mean(np.diag(matrix)))
    factor, added = safe_cholesky(matrix + least * np.eye(len(matrix)))
    return factor, least + added


def inverse_factor(factor: FloatArray) -> FloatArray:
    """Inverse of a lower triangular matrix."""
    return np.tril(solve_triangular(factor, np.eye(len(factor)), lower=True))


def exact(
    kernel: Kernel,
    x: FloatArray,
    y: FloatArray,
    noise: FloatArray | float,
    *,
    jitter: float | None = None,
) -> Numbers:
    """The exact posterior: every sample is a support point. x (n_in, N), y (N,), noise variance
    (N,) or one for all.

    Rasmussen and Williams (2006), algorithm 2.1. O(N^3).
    """
    n = len(y)
    matrix = kernel.covariance(x, x)
    matrix[np.diag_indices(n)] += noise
    factor, added = safe_cholesky(matrix, jitter)
    half = solve_triangular(factor, y, lower=True)
    likelihood = (
        -0.5 * float(half @ half)
        - float(np.log(np.diag(factor)).sum())
        - 0.5 * n * np.log(2.0 * np.pi)
    )
    return Numbers(
        weights=solve_triangular(factor, half, lower=True, trans="T"),
        explained=inverse_factor(factor),
        uncertain=np.zeros((n, n)),
        jitter=added,
        log_likelihood=likelihood,
    )


def collapsed(
    kernel: Kernel,
    support: FloatArray,
    x: FloatArray,
    y: FloatArray,
    noise: FloatArray | float,
    *,
    correction: bool = True,
    jitter: float | None = None,
) -> Numbers:
    """The sparse posterior in closed form: all data projected on `support` (n_in, M).

    Titsias, Variational learning of inducing variables in sparse Gaussian processes (AISTATS 2009).
    With `correction` each sample's noise grows by the variance that the support points leave
    unexplained there, as in Snelson and Ghahramani (NIPS 2005) and as GPyTorch predicts by default
    (`sgpr_diagonal_correction`): samples that are badly represented count less. Without, it is the
    optimal q(u) of the Titsias bound. x (n_in, N), y (N,), noise variance (N,) or one for all. O(N
    M^2) time, O(CHUNK M) memory beyond the data.
    """
    n, m = len(y), support.shape[1]
    level = np.broadcast_to(np.asarray(noise, dtype=np.float64), (n,))
    factor, added = safe_cholesky(kernel.covariance(support, support), jitter)
    inner, projected = np.eye(m), np.zeros(m)
    fit = log_noise = trace = 0.0
    for at in range(0, n, CHUNK):
        part = slice(at, min(at + CHUNK, n))
        a = solve_triangular(factor, kernel.covariance(support, x[:, part]), lower=True)
        left = np.maximum(kernel.prior_variance(x[:, part]).ravel() - (a * a).sum(0), 0.0)
        if correction:
            root = np.sqrt(level[part] + left)
        else:
            root = np.sqrt(level[part])
            trace += float((left / level[part]).sum())
        a /= root
        inner += a @ a.T
        target = y[part] / root
        projected += a @ target
        fit += float(target @ target)
        log_noise += 2.0 * float(np.log(root).sum())
    inner_factor, _ = safe_cholesky(inner)
    c = solve_triangular(inner_factor, projected, lower=True)
    likelihood = -0.5 * (
        n * np.log(2.0 * np.pi)
        + log_noise
        + 2.0 * float(np.log(np.diag(inner_factor)).sum())
        + fit
        - float(c @ c)
        + trace
    )
    half = solve_triangular(inner_factor, c, lower=True, trans="T")
    explained = inverse_factor(factor)
    return Numbers(
        weights=solve_triangular(factor, half, lower=True, trans="T"),
        explained=explained,
        uncertain=np.tril(solve_triangular(inner_factor, explained, lower=True)),
        jitter=added,
        log_likelihood=float(likelihood),
    )


def variance_guard(
    kernel: Kernel,
    support: FloatArray,
    numbers: Numbers,
    x: FloatArray,
    noise: FloatArray | float,
    *,
    seed: int = 0,
) -> float:
    """Factor of at least 1 that brings the variance of `collapsed` up to the full GP's.

    A sparse posterior takes what the support points do not determine for zero when it weighs the
    data, and so its variance can fall below the exact one (by up to a tenth here and there, where
    the points are few). The factor is the largest ratio of the two over `PROBES` training inputs
    and as many around them. x (n_in, N) and noise as in `collapsed`; of more than `GUARD_SAMPLES`
    samples a random part stands for all, its noise scaled so that it weighs as much.
    """
    n = x.shape[1]
    rng = np.random.default_rng(seed)
    rows = np.sort(rng.permutation(n)[:GUARD_SAMPLES])
    level = np.broadcast_to(np.asarray(noise, dtype=np.float64), (n,))[rows] * (rows.size / n)
    near = x[:, rng.permutation(n)[:PROBES]]
    around = near * rng.uniform(1.0, 1.2, near.shape[1]) + 0.2 * rng.standard_normal(near.shape)
    probes = np.concatenate([near, around], axis=1)
    prior = kernel.prior_variance(probes).ravel()
    matrix = kernel.covariance(x[:, rows], x[:, rows])
    matrix[np.diag_indices(rows.size)] += level
    factor, _ = safe_cholesky(matrix)
    full = prior - (
        solve_triangular(factor, kernel.covariance(x[:, rows], probes), lower=True) ** 2
    ).sum(0)
    k = kernel.covariance(support, probes)
    conditional = np.maximum(prior - ((numbers.explained @ k) ** 2).sum(0), 0.0)
    variance = conditional + ((numbers.uncertain @ k) ** 2).sum(0)
    return max(1.0, float((full / np.maximum(variance, 1e-9 * prior)).max()))


def variational(
    kernel: Kernel,
    support: FloatArray,
    mean: FloatArray,
    root: FloatArray,
    *,
    jitter: float | None = None,
) -> Numbers:
    """The posterior of a whitened q(v) = N(mean, root root'), u = L v with K(Z, Z) + jitter I = L
    L' (SVGP).

    Hensman, Fusi and Lawrence, Gaussian processes for big data (UAI 2013). support (n_in, M), mean
    (M,), root (M, M).
    """
    factor, added = support_factor(kernel, support, jitter)
    explained = inverse_factor(factor)
    # |root' L^-1 k|^2 = |R k|^2 with a triangular R: QR of the reversed columns gives a lower one.
    upper = qr((root.T @ explained)[:, ::-1], mode="r")[0][: len(mean)]
    return Numbers(
        weights=solve_triangular(factor, mean, lower=True, trans="T"),
        explained=explained,
        uncertain=np.tril(upper[::-1, ::-1]),
        jitter=added,
        log_likelihood=None,
    )
