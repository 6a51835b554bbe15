"""Known: what an identified model says before new flights are looked at."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from greybox.model.effect import Effect
from greybox.model.identified import IdentifiedModel

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
    """Parameter -> its number with its error; of those that differ from flight to flight with that
    spread. With numbers that are `given`: of the others, were these so (a Gaussian posterior)."""
    names, given = list(model.covariance_names), dict(given or {})
    variances = np.diag(model.covariance).copy()
    values = np.array([float(model.values[n]) for n in names])
    at = [i for i, n in enumerate(names) if n in given]
    if at:
        gain = np.linalg.lstsq(model.covariance[np.ix_(at, at)], model.covariance[at], rcond=None)[
            0
        ]
        values += gain.T @ (np.array([given[names[i]] for i in at]) - values[at])
        told = (gain * model.covariance[at]).sum(axis=0)
        variances = np.maximum(variances - told, LEAST * variances)
    variances += np.array([model.form_errors.get(n, 0.0) ** 2 for n in names])
    prior = {
        n: (float(v), float(np.sqrt(s)))
        for n, v, s in zip(names, values, variances, strict=True)
        if s > 0
    }
    # What did not vary between flights is no reason to believe that it never does.
    spread = {n: (float(m), float(s)) for n, (m, s) in model.flight_spread.items()}
    return prior | {n: (m, s if s > 0 else np.inf) for n, (m, s) in spread.items()}
