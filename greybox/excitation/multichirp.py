"""Multi-sine chirp: several sines that sweep neighbouring bands at once, so that every moment
excites the whole range."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from greybox.excitation.signal import Array


@dataclass(frozen=True, kw_only=True)
class Multichirp:
    """`count` sines; sine k sweeps band k of [low, high] Hz, up and down in `sweep` s, scaled to
    root-mean-square `rms`.

    The bands are equal parts of the logarithmic frequency axis; phases and places in the sweep are
    random. Amplitudes fall with frequency to the power of `slope` (0: white over the bands), so
    that a fast sine does not saturate a motor.
    """

    rms: float
    low: float = 0.1
    high: float = 20.0
    count: int = 6
    sweep: float = 4.0
    slope: float = 0.0

    def __call__(self, time: Array, rng: np.random.Generator) -> Array:
        """Values at the times (N,), N >= 2; shape (N,)."""
        edges = np.geomspace(self.low, self.high, self.count + 1)
        step = np.diff(time, prepend=2.0 * time[0] - time[1])
        total, power = np.zeros_like(time), 0.0
        for begin, end in itertools.pairwise(edges):
            place = 2.0 * np.mod(time / self.sweep + rng.uniform(), 1.0)
            frequency = begin * (end / begin) ** np.where(place < 1.0, place, 2.0 - place)
            size = (begin * end) ** (-0.5 * self.slope)
            total += size * np.sin(2.0 * np.pi * (np.cumsum(frequency * step) + rng.uniform()))
            power += 0.5 * size**2
        return np.asarray(self.rms / np.sqrt(power) * total)
