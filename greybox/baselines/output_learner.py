"""A learner's features on the one-step errors of a model: their last layer in closed form.

Errors of one sample are what a linear model leaves, and features are linear in their weights, so
that these are Bayesian linear regression (Bishop 2006, Pattern Recognition and Machine Learning,
sec. 3.3). Everything is chosen on flights that were not seen: features are made again from one half
of the flights and weights without the judged fold; of the candidates the one stays that foretells
the left-out errors best, of the strengths of the prior the strongest that is as good within one
standard error. What a network has memorised of the flights that judge it therefore gains nothing.
Outside of the training inputs nothing is believed (`greybox.residual.learners.inside`). What
remains is judged as a Gaussian process is (`greybox.residual.left_out`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from greybox.errors import ModelError
from greybox.residual.candidates import FeatureMaker
from greybox.residual.discrepancy import Discrepancy
from greybox.residual.feature_posterior import FeaturePosterior
from greybox.residual.learners import Learner
from greybox.residual.learners.inside import Inside, seen_share
from greybox.residual.left_out import STRETCHES, folds_of_rows, judged_on_errors
from greybox.residual.selection import IntArray, blocks_of
from greybox.residual.weight_space import alone, fitted
from greybox.symbolic import BoolArray, FloatArray, evaluate

STRENGTHS = (1e-2, 1e-1, 1.0, 1e1, 1e2, 1e3)
"""Variance of the noise over that of a weight, to choose from."""


@dataclass(frozen=True, kw_only=True, eq=False)
class OutputFit:
    """The judged posterior, the candidate that it is, the share of the left-out squared errors that
    each candidate saves, and held-out scores by output."""

    posterior: FeaturePosterior
    chosen: str
    candidates: Mapping[str, float]
    scores: tuple[dict[str, float], ...]


def fit_features(
    learner: Learner, rows: Discrepancy, own: FloatArray, *, points: int, seed: int
) -> OutputFit:
    """Features on one-step errors. `rows`: inputs z (N, n_in) and errors y (N, n_out) of a model,
    in order of time within each flight; `own` (n_out,) the variance that the model states for them.

    Raises `ModelError` as `FeatureMaker.candidates`, and where no candidate can be made from half
    of the flights.
    """
    maker = FeatureMaker(learner=Inside(learner), sets={"errors": rows}, points=points, seed=seed)
    found = maker.candidates(lambda _text, _share: None)
    _, flights = np.unique(rows.flights, return_inverse=True)
    fold = folds_of_rows(flights)
    second = _second_half(flights, fold)
    trials: dict[str, _Trial] = {}
    for label in found:
        made = [maker.again(label, half) for half in (~second, second)]
        apart = [m for m in made if m is not None]
        if len(apart) == len(made):
            trials[label] = _trial(apart, rows, fold, second, flights)
    if not trials:
        raise ModelError(
            f"the learner {learner.name} offers nothing from half of the flights",
            fix="more flights, or another --learner",
        )
    # Shares per output: their units differ.
    level = np.mean(rows.y**2, axis=0)
    saved = {n: float(1 - np.mean(np.mean(t.error**2, axis=0) / level)) for n, t in trials.items()}
    best = max(saved, key=lambda n: saved[n])
    candidate, trial = found[best], trials[best]
    assert isinstance(candidate, FeaturePosterior)
    last = _LastLayer.of(candidate, rows)
    everything = np.ones(len(rows.y), dtype=bool)
    whole = last.fitted(everything, trial.strengths, trial.level / candidate.output_scale**2)
    seen = list(zip(trial.error.T, trial.variance.T, strict=True))
    judged, scores = judged_on_errors(whole, seen, rows.y, flights, own)
    assert isinstance(judged, FeaturePosterior)
    return OutputFit(posterior=judged.at_home(rows.z), chosen=best, candidates=saved, scores=scores)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Trial:
    """Strength per output (n_out,) and mean squared left-out error (n_out,); errors and variances
    (N, n_out) of the function on rows that neither features nor weights have seen."""

    strengths: FloatArray
    level: FloatArray
    error: FloatArray
    variance: FloatArray


@dataclass(frozen=True, kw_only=True, eq=False)
class _LastLayer:
    """A candidate with its features (N, M) that the data inform, how much they are left of there
    (N, 1), and the errors (N, n_out) in units of its outputs.

    Errors count by that share too: what fades is the row, not the law through it."""

    candidate: FeaturePosterior
    phi: FloatArray
    near: FloatArray
    y: FloatArray

    @classmethod
    def of(cls, candidate: FeaturePosterior, rows: Discrepancy) -> _LastLayer:
        x = (rows.z - candidate.input_mean) / candidate.input_scale
        phi = evaluate(candidate.phi, np.ascontiguousarray(x))
        near, last = seen_share(phi, candidate.phi, candidate.members)
        phi[:, last] = 0.0
        return cls(
            candidate=candidate, phi=phi, near=near[:, None], y=rows.y / candidate.output_scale
        )

    def normal(self, rows: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Normal equations (M, M) and (M, n_out) of some rows, members of an ensemble apart."""
        phi = self.phi[rows]
        matrix = alone(phi.T @ phi, self.candidate.members, phi.shape[1])
        return matrix, np.asarray(phi.T @ (self.near[rows] * self.y[rows]))

    def fitted(self, rows: BoolArray, strengths: FloatArray, level: FloatArray) -> FeaturePosterior:
        """Weights from `rows` (N,); strengths and noise variance `level` (n_out,), in units of the
        outputs."""
        matrix, right = self.normal(rows)
        m, n_out = right.shape
        theta, covariance = np.zeros(m * n_out), np.zeros((m * n_out, m * n_out))
        for j, strength in enumerate(strengths):
            at = slice(j * m, (j + 1) * m)
            inverse = np.linalg.inv(matrix + strength * np.eye(m))
            theta[at] = inverse @ right[:, j] / self.candidate.members
            covariance[at, at] = level[j] * inverse
        found = fitted(self.candidate, theta, covariance, level / strengths)
        assert isinstance(found, FeaturePosterior)
        return found


def _trial(
    made: Sequence[FeaturePosterior],
    rows: Discrepancy,
    fold: IntArray,
    second: BoolArray,
    flights: IntArray,
) -> _Trial:
    """Left-out errors of a candidate: `made` from the first half of the rows and from the second,
    each judged on the folds of the other half with weights from all other folds."""
    layers = [_LastLayer.of(candidate, rows) for candidate in made]
    judges = {int(f): layers[0 if second[fold == f].all() else 1] for f in np.unique(fold)}
    errors, inner = np.empty((2, len(STRENGTHS), *rows.y.shape))
    near = np.empty((len(rows.y), 1))
    for f, last in judges.items():
        out = fold == f
        matrix, right = last.normal(~out)
        for i, strength in enumerate(STRENGTHS):
            ridge = matrix + strength * np.eye(len(matrix))
            weights = np.linalg.solve(ridge, right) / last.candidate.members
            told = last.candidate.output_scale * (last.phi[out] @ weights)
            errors[i, out] = rows.y[out] - told
            inner[i, out] = last.near[out] * rows.y[out] - told
        near[out] = last.near[out]
    chosen = _strongest(errors**2, blocks_of(flights, at_least=12))
    columns = np.arange(rows.y.shape[1])
    # What scatters the weights is what is left of the errors that they were fitted to.
    level = np.mean(inner[chosen, :, columns] ** 2, axis=1) / np.mean(near**2)
    variance = np.empty(rows.y.shape)
    strengths = np.array(STRENGTHS)[chosen]
    for f, last in judges.items():
        out = fold == f
        post = last.fitted(~out, strengths, level / last.candidate.output_scale**2)
        variance[out] = post.evaluate(rows.z[out])[1]
    return _Trial(
        strengths=strengths, level=level, error=errors[chosen, :, columns].T, variance=variance
    )


def _strongest(square: FloatArray, block: IntArray) -> IntArray:
    """Per output the strongest prior (n_out,) whose squared left-out errors (n_strengths, N, n_out)
    are within one standard error of the least, by means over `block` (N,) (Breiman et al. 1984,
    sec. 3.4.3)."""
    means = np.stack([square[:, block == b].mean(axis=1) for b in np.unique(block)])
    best = np.argmin(means.mean(axis=0), axis=0)
    worse = means - means[:, best, np.arange(len(best))][:, None]
    error = worse.std(axis=0, ddof=1) / np.sqrt(len(means))
    within = worse.mean(axis=0) <= error
    return np.asarray(len(STRENGTHS) - 1 - np.argmax(within[::-1], axis=0))


def _second_half(flights: IntArray, fold: IntArray) -> BoolArray:
    """Which rows (N,) are in the second half: every other flight, or the end of a single one."""
    if np.array_equal(flights, fold):
        return np.asarray(flights % 2 == 1)
    return np.asarray(fold >= STRETCHES // 2)
