"""Unit strings as dimensions: "N s^2/m^2" is kg^1 m^-1. Names without a dimension: rad, - and 1."""

from __future__ import annotations

from collections import Counter

import numpy as np

BASE = ("kg", "m", "s", "V")
DERIVED = {"N": {"kg": 1, "m": 1, "s": -2}, "rad": {}, "-": {}, "1": {}}


def dimensions(unit: str) -> dict[str, int]:
    """Exponents of kg, m, s, V. Every factor after a slash is below the line. Raises ValueError for
    an unknown unit."""
    out: Counter[str] = Counter()
    for place, part in enumerate(unit.split("/")):
        for factor in part.split():
            name, _, power = factor.partition("^")
            if name not in BASE and name not in DERIVED:
                raise ValueError(f"unknown unit {name!r} in {unit!r}")
            exponent = int(power or 1) * (-1 if place else 1)
            for base, n in ({name: 1} if name in BASE else DERIVED[name]).items():
                out[base] += n * exponent
    return {k: v for k, v in out.items() if v}


def factor(unit: str, scale: dict[str, float]) -> float:
    """By what a number with this unit grows when the base units shrink by `scale`."""
    return float(np.prod([scale[base] ** power for base, power in dimensions(unit).items()]))


def factors(units, scale) -> np.ndarray:
    """`factor` of several units."""
    return np.array([factor(u, scale) for u in units])
