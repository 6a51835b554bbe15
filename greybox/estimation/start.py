"""Where a fit starts: at what is known of its unknowns, often from a fit of another structure or of
other flights."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from greybox.estimation.unknown import SearchSpace
from greybox.symbolic import FloatArray

Key = tuple[str, str | None]
"""An unknown and, where it is one flight's own, the flight (or record)."""
Start = Mapping[Key, float]


def vector(space: SearchSpace, known: Mapping[Key, float]) -> FloatArray:
    """Unknowns (n,) at the known values; one flight's own at what all share, or at
    the mean of other flights, where that is known; else as they start."""
    others: dict[str, list[float]] = {}
    for (name, flight), value in known.items():
        if flight is not None:
            others.setdefault(name, []).append(value)

    def of(name: str, flight: str | None, start: float, kind: str) -> float:
        if (name, flight) in known:
            return known[name, flight]
        if (name, None) in known:
            return known[name, None]
        if kind == "parameter" and name in others:
            return float(np.mean(others[name]))
        return start

    return np.array(
        [of(u.name, u.flight, u.start, u.kind) for u in space.unknowns], dtype=np.float64
    )
