"""Units as powers of their symbols."""

from __future__ import annotations

import re

MASSES = ("kg", "N")
"""Symbols that hold a mass, once each."""


def powers_of(unit: str) -> dict[str, int]:
    """Symbol -> power of a unit as units are written here: "N s^2/m^2" is {"N": 1, "s": 2, "m":
    -2}."""
    over, _, under = unit.partition("/")
    powers: dict[str, int] = {}
    for part, sign in ((over, 1), (under, -1)):
        for symbol, power in re.findall(r"([A-Za-z]+)(?:\^(\d+))?", part):
            powers[symbol] = powers.get(symbol, 0) + sign * int(power or 1)
    return powers


def power_of_mass(unit: str) -> int:
    """How often a unit holds a mass."""
    return sum(power for symbol, power in powers_of(unit).items() if symbol in MASSES)
