"""Known: what an identified model says before new flights are looked at."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import stdtrit

from greybox.model.effect import Effect
from greybox.model.identified import IdentifiedModel
from greybox.symbolic import FloatArray

LEAST = 1e-6
"""Share of a variance that is left at least where another number is given."""


@dataclass(frozen=True, kw_only=True)
class Known:
    """What an identified model says: its effects, (value, sigma) of every number, and what drives
    it."""

    effects: tuple[Effect, ...]
    prior: Mapping[str, tuple[float, float]]
    input: Literal["command", "speed"]


def since(model: IdentifiedModel) -> Known:
    """An identified model of a vehicle as what is known before new flights."""
    physics = model.physics
    return Known(effects=tuple(physics.effects), prior=known_numbers(model), input=physics.input)


def known_numbers(
    model: IdentifiedModel, given: Mapping[str, float] | None = None
) -> dict[str, tuple[float, float]]:
    """Parameter -> its number with its error; of those that differ from flight to flight with the
    error of one more flight. With numbers that are `given`: of the others, were these so (a
    Gaussian posterior).

    The numbers are taken for independent by whoever gets them. Five that share one unknown scale
    would then measure it five times. So each variance is multiplied by the sum of its absolute
    correlations: the diagonal matrix of these is at least the covariance (Gershgorin), and no
    direction is known better than it was.
    """
    names, values, covariance = _joint(model)
    given = dict(given or {})
    at = [i for i, n in enumerate(names) if n in given]
    if at:
        gain = np.linalg.lstsq(covariance[np.ix_(at, at)], covariance[at], rcond=None)[0]
        values += gain.T @ (np.array([given[names[i]] for i in at]) - values[at])
        whole = np.diag(covariance)
        covariance = covariance - gain.T @ covariance[at]
        np.fill_diagonal(covariance, np.maximum(np.diag(covariance), LEAST * whole))
    variances = np.diag(covariance) * _shared(covariance)
    variances += np.array([model.form_errors.get(n, 0.0) ** 2 for n in names])
    prior = {
        n: (float(v), float(np.sqrt(s)))
        for n, v, s in zip(names, values, variances, strict=True)
        if s > 0
    }
    # What did not vary between flights is no reason to believe that it never does.
    spread = {
        n: (float(m), float(s) * _of_one_more(model, n))
        for n, (m, s) in model.flight_spread.items()
    }
    return prior | {n: (m, s if s > 0 else np.inf) for n, (m, s) in spread.items()}


def _joint(model: IdentifiedModel) -> tuple[list[str], FloatArray, FloatArray]:
    """(names, values, covariance) of what was estimated, and of what was held and not exact."""
    n, held = len(model.covariance_names), list(model.considered)
    names = [*model.covariance_names, *held]
    covariance = np.zeros((len(names), len(names)))
    covariance[:n, :n] = model.covariance
    for j, (sigma, moves) in enumerate(model.considered.values(), n):
        together = [sigma**2 * moves.get(name, 0.0) for name in names[:n]]
        covariance[:n, j] = covariance[j, :n] = together
        covariance[j, j] = sigma**2
    return names, np.array([float(model.values[name]) for name in names]), covariance


def _shared(covariance: FloatArray) -> FloatArray:
    """Sum of the absolute correlations of each number with all, itself included."""
    error = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    size = np.outer(error, error)
    known = np.divide(np.abs(covariance), size, out=np.zeros_like(size), where=size > 0)
    return np.minimum(known, 1.0).sum(axis=1)


def _of_one_more(model: IdentifiedModel, name: str) -> float:
    """Factor on the spread of what flights had, so that 95 % of next ones are within 1.96 of it
    (Student's prediction interval): two flights hardly tell how far a third may be."""
    n = sum(name in own for own in model.per_flight.values())
    return float(stdtrit(n - 1, 0.975) / 1.96 * np.sqrt(1 + 1 / n)) if n > 1 else 1.0
