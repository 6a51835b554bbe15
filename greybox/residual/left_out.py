"""An output residual judged and calibrated as it will be used: on flights that its weights did not see.

Kernels and support points stay, weights are projected again without each fold (a flight, or a
stretch where there are few), in closed form. The noise of a new sample is the level that makes the
left-out errors most likely, and an output keeps its GP only where its density on them beats that of
the model alone, with the model's own innovation covariance, by more than chance. Errors of the
flights that were learned from are too small to say either, and a constant is too weak a rival.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.optimize

from greybox.residual import sparse
from greybox.residual.judgement import CHANCE, better_by_chance
from greybox.residual.kernels import Kernel
from greybox.residual.posterior import GPPosterior
from greybox.residual.selection import IntArray, blocks_of
from greybox.symbolic import BoolArray, FloatArray

FEW, STRETCHES = 4, 4
"""With fewer flights than this, each is cut into so many stretches, which are left out in turn."""
WIDEST = 10.0
"""The noise level is looked for within this factor of the root mean square of the left-out errors."""


def judged_on_left_out(
    posterior: GPPosterior, z: FloatArray, y: FloatArray, flights: IntArray, own: FloatArray
) -> tuple[GPPosterior, tuple[dict[str, float], ...]]:
    """(the posterior, calibrated, with the outputs switched off that lose; held-out scores by output).

    z (N, n_in), y (N, n_out) one-step errors of the model, `flights` (N,) numbers in order of time,
    `own` (n_out,) the variance that the model states for them. An output that is off foretells what
    the model does: no mean, and variance `own`.
    """
    fold = flights if np.unique(flights).size >= FEW else _stretches(flights)
    block = blocks_of(flights, at_least=12)
    off = np.array([not a for a in posterior.active])
    noise, scores = posterior.noise.copy(), []
    for j in range(len(posterior.outputs)):
        plain = _nlpd(y[:, j] ** 2, np.full(len(y), own[j]))
        found = {"nlpd_model": float(plain.mean())}
        if not off[j]:
            error, variance = _left_out(posterior, j, z, y[:, j], fold)
            noise[j] = _likeliest(error**2, variance)
            gain = plain - _nlpd(error**2, variance + noise[j])
            off[j] = gain.mean() <= 0 or better_by_chance(gain, block) > CHANCE
            found |= {"nlpd": float(plain.mean() - gain.mean()), "gain": float(gain.mean())}
        scores.append(found)
    return _switched_off(replace(posterior, noise=noise, group_noise={}), off, own), tuple(scores)


def _stretches(flights: IntArray) -> IntArray:
    fold = np.empty(len(flights), dtype=np.int64)
    for i, f in enumerate(np.unique(flights)):
        rows = np.flatnonzero(flights == f)
        fold[rows] = i * STRETCHES + np.arange(rows.size) * STRETCHES // rows.size
    return fold


def _left_out(
    posterior: GPPosterior, j: int, z: FloatArray, y: FloatArray, fold: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Errors (N,) and variances (N,) of the function of output j, each fold by the weights of the others."""
    kernel, support = posterior.kernels[j], posterior.support.T
    scale, centre = posterior.output_scale[j], posterior.output_mean[j]
    x = ((z - posterior.input_mean) / posterior.input_scale).T
    level = posterior.noise[j] * posterior.noise_inflation[j] / scale**2
    error, variance = np.empty(len(y)), np.empty(len(y))
    for f in np.unique(fold):
        out = fold == f
        numbers = sparse.collapsed(kernel, support, x[:, ~out], (y[~out] - centre) / scale, level)
        k = kernel.covariance(support, x[:, out])
        left = np.maximum(kernel.prior_variance(x[:, out]).ravel() - ((numbers.explained @ k) ** 2).sum(axis=0), 0.0)
        error[out] = y[out] - centre - scale * (numbers.weights @ k)
        variance[out] = scale**2 * posterior.variance_factor[j] * (left + ((numbers.uncertain @ k) ** 2).sum(axis=0))
    return error, variance


def _nlpd(square: FloatArray, variance: FloatArray) -> FloatArray:
    return np.asarray(0.5 * (np.log(2 * np.pi * variance) + square / variance))


def _likeliest(square: FloatArray, variance: FloatArray) -> float:
    """The noise variance that makes errors with these squares (N,) and function variances (N,) most likely."""
    middle = np.log(np.mean(square))
    ends = (middle - 2 * np.log(WIDEST), middle + 2 * np.log(WIDEST))
    found = scipy.optimize.minimize_scalar(
        lambda s: float(_nlpd(square, variance + np.exp(s)).mean()), bounds=ends, method="bounded"
    )
    return float(np.exp(found.x))


def _switched_off(posterior: GPPosterior, off: BoolArray, own: FloatArray) -> GPPosterior:
    """The posterior whose outputs in `off` (n_out,) say nothing: no mean, no variance but the noise `own`."""
    on = ~off
    kernels = tuple(
        Kernel(family=k.family, lengthscales=k.lengthscales, variance=0.0) if o else k
        for k, o in zip(posterior.kernels, off, strict=True)
    )
    return replace(
        posterior, kernels=kernels, weights=posterior.weights * on, output_mean=posterior.output_mean * on,
        explained=posterior.explained * on[:, None, None], uncertain=posterior.uncertain * on[:, None, None],
        noise=np.where(off, own, posterior.noise),
    )  # fmt: skip
