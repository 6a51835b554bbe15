"""Fewer support points for an exported learned part, from the posterior alone (the training data
are not in a model file).

Of the M support points those are kept that determine the functions best (greedy pivoted Cholesky on
the share of prior variance left unexplained: Burt, Rasmussen and van der Wilk, JMLR 21, 2020). At
these the new posterior has exactly the old one's mean and covariance, and the prior's conditional
between them (Hensman, Fusi and Lawrence, UAI 2013). What it loses is measured over the old support
points and inside the training box, and reported.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TypedDict

import numpy as np
from scipy.linalg import solve_triangular

from greybox.errors import ModelError
from greybox.model.identified import IdentifiedModel
from greybox.model.linear import LinearModel
from greybox.residual.feature_posterior import FeaturePosterior
from greybox.residual.hybrid import HybridModel
from greybox.residual.posterior import GPPosterior
from greybox.residual.sparse import safe_cholesky, support_factor, variational
from greybox.symbolic import FloatArray
from mpc_export.predictors import PredictorModel

PROBES = 500


class Reduction(TypedDict):
    """What fewer support points cost: error of the mean in units of its spread, and by how much the
    stated deviation grows, of every active output."""

    points: int
    of: int
    outputs: list[str]
    mean_error: list[float]
    deviation_ratio: list[float]


def with_points(
    model: IdentifiedModel | LinearModel | PredictorModel, points: int
) -> tuple[IdentifiedModel, Reduction | None]:
    """The model with at most `points` support points in its learned part, and what that costs
    (None: nothing changed).

    Raises `ModelError` for a model without a learned part or fewer than one point.
    """
    if points < 1:
        raise ModelError(
            "--points", expected="a positive number of support points", got=str(points)
        )
    if not isinstance(model, IdentifiedModel) or not isinstance(model.dynamics, HybridModel):
        raise ModelError(
            "--points needs a model with a learned part", got=model.name, fix="leave --points out"
        )
    old = model.dynamics.posterior
    if isinstance(old, FeaturePosterior):
        raise ModelError(
            "--points takes support points of a Gaussian process away",
            got=f"the learner {old.method}",
            fix="leave --points out here, and give fewer --points to `greybox learn`",
        )
    if points >= old.points:
        return model, None
    new = reduced(old, points)
    rng = np.random.default_rng(0)
    inside = old.domain.lower + rng.random((PROBES, len(old.inputs))) * (
        old.domain.upper - old.domain.lower
    )
    probes = np.vstack([old.support_points, inside])
    (m1, v1), (m2, v2) = old.evaluate(probes), new.evaluate(probes)
    on = np.array(old.active)
    size = np.maximum(np.std(m1[:, on], axis=0), 1e-300)
    error = np.sqrt(np.mean((m2 - m1)[:, on] ** 2, axis=0)) / size
    wider = np.median(np.sqrt(v2[:, on] / np.maximum(v1[:, on], 1e-300)), axis=0)
    report: Reduction = {
        "points": points,
        "of": old.points,
        "outputs": [n for n, a in zip(old.outputs.names, old.active) if a],
        "mean_error": error.tolist(),
        "deviation_ratio": np.asarray(wider).tolist(),
    }
    return replace(model, dynamics=replace(model.dynamics, posterior=new)), report


def reduced(old: GPPosterior, points: int) -> GPPosterior:
    """The posterior on `points` of its own support points."""
    chosen = _greedy(old, points)
    support = old.support[chosen]
    z, kept = old.support.T, support.T
    weights = np.zeros((points, len(old.outputs)))
    explained, uncertain = (np.zeros((len(old.outputs), points, points)) for _ in range(2))
    jitter = list(old.jitter)
    for j, kernel in enumerate(old.kernels):
        if not old.active[j]:
            continue
        cross = kernel.covariance(z, kept)
        first, second = old.explained[j] @ cross, old.uncertain[j] @ cross
        covariance = kernel.covariance(kept, kept) - first.T @ first + second.T @ second
        prior, _ = support_factor(kernel, kept)
        root, _ = safe_cholesky(0.5 * (covariance + covariance.T))
        mean = cross.T @ old.weights[:, j]
        numbers = variational(
            kernel,
            kept,
            solve_triangular(prior, mean, lower=True),
            solve_triangular(prior, root, lower=True),
        )
        weights[:, j], explained[j], uncertain[j] = (
            numbers.weights,
            numbers.explained,
            numbers.uncertain,
        )
        jitter[j] = numbers.jitter
    new = replace(
        old,
        method="svgp",
        support=support,
        weights=weights,
        explained=explained,
        uncertain=uncertain,
        jitter=tuple(jitter),
    )
    # The old support points stand for the training inputs, which are not at hand.
    q = [
        float(d)
        for d in np.quantile(new.evaluate_distance(old.support_points), [0.5, 0.95, 0.99, 1.0])
    ]
    return replace(new, domain=replace(old.domain, distance=(q[0], q[1], q[2], q[3])))


def _greedy(posterior: GPPosterior, points: int) -> list[int]:
    """Support points in the order of what they still explain, over all active outputs."""
    kernels = {
        id(k): k for k, on in zip(posterior.kernels, posterior.active, strict=True) if on
    }.values()
    z = posterior.support.T
    matrices = [k.covariance(z, z) / np.mean(k.prior_variance(z)) for k in kernels]
    left: list[FloatArray] = [np.diag(m).copy() for m in matrices]
    rows: list[list[FloatArray]] = [[] for _ in matrices]
    chosen: list[int] = []
    for _ in range(points):
        worth = np.sum(left, axis=0) if left else np.ones(posterior.points)
        worth[chosen] = -np.inf
        pick = int(np.argmax(worth))
        chosen.append(pick)
        for m, rest, own in zip(matrices, left, rows):
            row = m[pick] - sum(r[pick] * r for r in own)
            row = row / np.sqrt(max(row[pick], 1e-12))
            own.append(row)
            np.maximum(rest - row**2, 0.0, out=rest)
    return chosen
