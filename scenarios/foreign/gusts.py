"""Gusts: wind, and a swirl that turns the craft, as Gauss-Markov processes that start in their
stationary state."""

from __future__ import annotations

import math

import numpy as np

from greybox.plants.vectors import Vector
from scenarios.foreign.craft import Air


class Gusts:
    """Wind [m/s, world] and swirl [rad/s^2, body] of one flight, constant over a sample of
    `sample_time` s. `air` may change in flight."""

    def __init__(self, air: Air, sample_time: float, seed: int) -> None:
        self.air = air
        self._keep = math.exp(-sample_time / air.gust_time)
        self._random = np.random.default_rng([seed, 3])
        self._state = self._random.standard_normal(6)
        # of their own, so that a craft without them feels the same wind
        self._loading = np.random.default_rng([seed, 4])
        self._load = self._loading.standard_normal(6)

    def advance(self) -> None:
        """Go to the next sample."""
        fresh = math.sqrt(1.0 - self._keep**2)
        self._state = self._keep * self._state + fresh * self._random.standard_normal(6)
        self._load = self._keep * self._load + fresh * self._loading.standard_normal(6)

    @property
    def wind(self) -> Vector:
        """The wind now."""
        mean, sigma = self.air.wind, self.air.gusts
        x, y, z = (m + sigma * float(s) for m, s in zip(mean, self._state[:3]))
        return (x, y, z)

    @property
    def swirl(self) -> Vector:
        """Angular acceleration by which the gusts turn the craft now."""
        x, y, z = (self.air.swirl * float(s) for s in self._state[3:])
        return (x, y, z)

    @property
    def push(self) -> Vector:
        """Force [N, world] of the gusts themselves."""
        x, y, z = (self.air.push * float(s) for s in self._load[:3])
        return (x, y, z)

    @property
    def turn(self) -> Vector:
        """Angular acceleration [rad/s^2, body] by which they turn the craft in every simulator."""
        x, y, z = (self.air.turn * float(s) for s in self._load[3:])
        return (x, y, z)
