"""Unknown: one scalar of the search space of a fit."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Unknown:
    """One scalar of the search space. `name` is the parameter's; `flight` is set for a per-flight
    copy.

    `start`, `lower` and `upper` are in the unit of the unknown (a noise level: in its natural
    logarithm), `mean` and `sigma` those of its Gaussian prior (sigma infinite: no prior), `scale`
    is its typical size. `origin` is the value at which the factor that it stands for vanishes
    (mass: 0, a share on top of a mass: -1), not a number where it is none.
    """

    name: str
    kind: str  # "parameter", "noise" or "initial"
    flight: str | None
    start: float
    lower: float
    upper: float
    mean: float
    sigma: float
    scale: float
    unit: str
    origin: float = math.nan
