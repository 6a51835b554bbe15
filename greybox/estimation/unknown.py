"""Unknown: one scalar of the search space of a fit; and all of them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from types import MappingProxyType

import numpy as np

from greybox.symbolic import FloatArray


@dataclass(frozen=True, kw_only=True)
class Unknown:
    """One scalar of the search space. `name` is the parameter's; `flight` is set for a per-flight
    copy.

    `start`, `lower` and `upper` are in the unit of the unknown (a noise level: in its natural
    logarithm), `mean` and `sigma` those of its prior (sigma infinite: no prior), which is normal
    or has `long_tails`, a `normal_core` within (see `greybox.estimation.prior`), `scale` is its
    typical size. `origin` is the value at which the factor that it stands for vanishes (mass: 0, a
    share on top of a mass: -1), not a number where it is none.
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
    long_tails: bool = False
    normal_core: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class SearchSpace:
    """The unknowns of a fit in their order. It can be sent to another process."""

    unknowns: tuple[Unknown, ...]

    def __getstate__(self) -> dict[str, object]:
        """Without what is worked out when it is asked for."""
        given = {f.name: getattr(self, f.name) for f in fields(self) if f.init}
        return {n: dict(v) if isinstance(v, MappingProxyType) else v for n, v in given.items()}

    @property
    def n(self) -> int:
        """Number of unknowns."""
        return len(self.unknowns)

    @property
    def lower(self) -> FloatArray:
        """Lower bounds."""
        return np.array([u.lower for u in self.unknowns])

    @property
    def upper(self) -> FloatArray:
        """Upper bounds."""
        return np.array([u.upper for u in self.unknowns])

    @property
    def scale(self) -> FloatArray:
        """Typical sizes, for conditioning."""
        return np.array([u.scale for u in self.unknowns])

    @cached_property
    def index(self) -> Mapping[tuple[str, str | None], int]:
        """(name, flight) -> place among the unknowns; flight None: shared by all."""
        return MappingProxyType({(u.name, u.flight): i for i, u in enumerate(self.unknowns)})
