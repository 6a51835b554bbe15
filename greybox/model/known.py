"""Known: what an identified model says before new flights are looked at."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from greybox.model.effect import Effect
from greybox.model.identified import IdentifiedModel


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


def known_numbers(model: IdentifiedModel) -> dict[str, tuple[float, float]]:
    """Parameter -> its number with its error; of those that differ from flight to flight with that
    spread."""
    errors = dict(zip(model.covariance_names, np.sqrt(np.diag(model.covariance)), strict=True))
    prior = {n: (float(model.values[n]), float(s)) for n, s in errors.items() if s > 0}
    return prior | {n: (float(m), float(s)) for n, (m, s) in model.flight_spread.items()}
