"""Bounds of the core parameters: where physics ends (schema "greybox.vehicle/2") or four sigma
(schema "greybox.vehicle/1").

A guess's sigma says how likely a value is, not which ones can be. Moments of inertia have limits
that are no box: see `greybox.estimation.feasible`.
"""

from __future__ import annotations

import math

from greybox.model.vehicle import Vehicle
from greybox.model.vehicle_parts import EXACT_SCHEMA

FOUR_SIGMA = 4.0
"""Schema /1: standard deviations to either side, so that a large missing effect cannot drag a prior
away."""
SMALLEST_OF_STATED = 0.2
"""Schema /1: positive quantities stay above this share of their value."""

FACTOR = 20.0
"""Schema /2: what cannot change its sign stays within this factor of its value. Craft of one arm
length differ by less in mass, inertia and thrust (Kushleyev et al. 2013: m ~ L^3, within a factor
of 10); slips of unit are a factor of 1000 and are found by `greybox vehicle check`."""

Range = tuple[float, float]


def core_bounds(vehicle: Vehicle, name: str) -> Range:
    """(lower, upper) of the core parameter `name` ("mass", "inertia.xx", "thrust.c2",
    "center_of_mass.x")."""
    quantity = vehicle.quantities[name]
    group = name.partition(".")[0]
    if vehicle.schema == EXACT_SCHEMA:
        positive = group in ("mass", "inertia")
        return _four_sigma(quantity.value, quantity.sigma, positive=positive)
    if group in ("mass", "inertia"):
        return _same_sign(quantity.value)
    if group == "center_of_mass":
        reach = max(vehicle.arm_length, 2 * abs(quantity.value))
        return -reach, reach
    curve = vehicle.actuator.thrust if group == "thrust" else vehicle.actuator.torque
    return _coefficient([q.value for q in curve], quantity.value)


def _four_sigma(value: float, sigma: float, *, positive: bool) -> Range:
    lower, upper = -math.inf, math.inf
    if sigma > 0 and math.isfinite(sigma):
        lower, upper = value - FOUR_SIGMA * sigma, value + FOUR_SIGMA * sigma
    if positive:
        lower = max(lower, SMALLEST_OF_STATED * value)
    return lower, upper


def _same_sign(value: float) -> Range:
    low, high = sorted((value / FACTOR, value * FACTOR))
    return low, high


def _coefficient(curve: list[float], value: float) -> Range:
    """One that carries the whole map keeps its sign; one of several may change it, within a factor
    of the largest."""
    if value != 0.0 and sum(c != 0.0 for c in curve) == 1:
        return _same_sign(value)
    size = FACTOR * max(abs(c) for c in curve)
    return (-size, size) if size > 0 else (-math.inf, math.inf)
