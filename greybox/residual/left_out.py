"""An output residual judged and calibrated as it will be used: on flights that its weights did not
see.

Kernels and support points stay, weights are projected again without each fold (a flight, or a
stretch of a single one), in closed form. The noise of a new sample is the level that makes the
left-out errors most likely, and an output keeps its GP only where its density on them beats that of
the model alone by more than chance. Errors of the flights that were learned from are too small to
say either, and a constant is too weak a rival.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy.optimize

from greybox.residual import sparse
from greybox.residual.judgement import CHANCE, better_by_chance
from greybox.residual.posterior import GPPosterior
from greybox.residual.selection import IntArray, blocks_of
from greybox.residual.weight_space import Candidate, without
from greybox.symbolic import FloatArray

STRETCHES = 4
"""A single flight is cut into so many stretches, which are left out in turn."""
Seen = tuple[FloatArray, FloatArray]
WIDEST = 10.0
"""The noise level is looked for within this factor of the root mean square of the left-out
errors."""


def judged_on_left_out(
    posterior: GPPosterior, z: FloatArray, y: FloatArray, flights: IntArray, own: FloatArray
) -> tuple[GPPosterior, tuple[dict[str, float], ...]]:
    """As `judged_on_errors`, for the weights of a process. z (N, n_in)."""
    fold = folds_of_rows(flights)
    seen = [
        _left_out(posterior, j, z, y[:, j], fold) if a else None
        for j, a in enumerate(posterior.active)
    ]
    found, scores = judged_on_errors(replace(posterior, group_noise={}), seen, y, flights, own)
    assert isinstance(found, GPPosterior)
    return found, scores


def judged_on_errors(
    posterior: Candidate,
    seen: Sequence[Seen | None],
    y: FloatArray,
    flights: IntArray,
    own: FloatArray,
) -> tuple[Candidate, tuple[dict[str, float], ...]]:
    """(the posterior, calibrated, with the outputs switched off that lose; held-out scores by
    output).

    `seen`: per output the errors (N,) and variances (N,) of its function on rows that its weights
    did not see, None where it is off already; y (N, n_out) one-step errors of the model, `flights`
    (N,) numbers in order of time, `own` (n_out,) the variance that the model states for them. The
    rival is the model with the noise level that suits it best, as the process has. An output that
    is off foretells what the model does: no mean, and variance `own`.
    """
    block = blocks_of(flights, at_least=12)
    off = np.array([s is None for s in seen])
    noise, scores = posterior.noise.copy(), []
    for j, left in enumerate(seen):
        square, none = y[:, j] ** 2, np.zeros(len(y))
        found = {"nlpd_model": float(_nlpd(square, none + own[j]).mean())}
        if left is not None:
            error, variance = left
            noise[j] = _likeliest(error**2, variance)
            told = _nlpd(error**2, variance + noise[j])
            gain = _nlpd(square, none + _likeliest(square, none)) - told
            off[j] = gain.mean() <= 0 or better_by_chance(gain, block) > CHANCE
            found |= {"nlpd": float(told.mean()), "gain": float(gain.mean())}
        scores.append(found)
    return without(replace(posterior, noise=noise), off, own), tuple(scores)


def folds_of_rows(flights: IntArray) -> IntArray:
    """Number of the fold of every row: its flight, or its stretch of a single flight. flights
    (N,)."""
    if np.unique(flights).size > 1:
        return flights
    return np.arange(len(flights)) * STRETCHES // len(flights)


def _left_out(
    posterior: GPPosterior, j: int, z: FloatArray, y: FloatArray, fold: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Errors (N,) and variances (N,) of the function of output j, each fold by the weights of the
    others."""
    kernel, support = posterior.kernels[j], posterior.support.T
    scale, centre = posterior.output_scale[j], posterior.output_mean[j]
    x = ((z - posterior.input_mean) / posterior.input_scale).T
    level = posterior.noise[j] * posterior.noise_inflation[j] / scale**2
    error, variance = np.empty(len(y)), np.empty(len(y))
    for f in np.unique(fold):
        out = fold == f
        numbers = sparse.collapsed(kernel, support, x[:, ~out], (y[~out] - centre) / scale, level)
        k = kernel.covariance(support, x[:, out])
        left = np.maximum(
            kernel.prior_variance(x[:, out]).ravel() - ((numbers.explained @ k) ** 2).sum(axis=0),
            0.0,
        )
        error[out] = y[out] - centre - scale * (numbers.weights @ k)
        variance[out] = (
            scale**2
            * posterior.variance_factor[j]
            * (left + ((numbers.uncertain @ k) ** 2).sum(axis=0))
        )
    return error, variance


def _nlpd(square: FloatArray, variance: FloatArray) -> FloatArray:
    return np.asarray(0.5 * (np.log(2 * np.pi * variance) + square / variance))


def _likeliest(square: FloatArray, variance: FloatArray) -> float:
    """The noise variance that makes errors with these squares (N,) and function variances (N,) most
    likely."""
    middle = np.log(np.mean(square))
    ends = (middle - 2 * np.log(WIDEST), middle + 2 * np.log(WIDEST))
    found = scipy.optimize.minimize_scalar(
        lambda s: float(_nlpd(square, variance + np.exp(s)).mean()), bounds=ends, method="bounded"
    )
    return float(np.exp(found.x))
