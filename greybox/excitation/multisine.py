"""Multisine: a sum of sines with random phases, the same power at every chosen frequency."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from greybox.excitation.signal import Array


@dataclass(frozen=True, kw_only=True)
class Multisine:
    """`count` sines spaced logarithmically over [low, high] Hz, scaled to root-mean-square value
    `rms`.

    Phases are random, and of `tries` draws the one with the smallest peak is kept. With `offset` k
    and `stride` n, a signal uses frequencies k, k+n, k+2n, ... of the grid only, so that several
    inputs excited at once stay orthogonal.
    """

    rms: float
    low: float = 0.2
    high: float = 8.0
    count: int = 24
    offset: int = 0
    stride: int = 1
    tries: int = 20

    def __call__(self, time: Array, rng: np.random.Generator) -> Array:
        """Values at the times (N,); shape (N,)."""
        frequencies = np.geomspace(self.low, self.high, self.count)[self.offset :: self.stride]
        phases = rng.uniform(0.0, 2.0 * np.pi, (self.tries, frequencies.size))
        check = np.linspace(0.0, 5.0 / self.low, 400)
        basis = 2.0 * np.pi * np.outer(frequencies, check)
        peaks = [np.max(np.abs(np.sum(np.sin(basis + phase[:, None]), axis=0))) for phase in phases]
        best = phases[int(np.argmin(peaks))]
        waves = np.sin(2.0 * np.pi * np.outer(time, frequencies) + best)
        return np.asarray(self.rms * np.sqrt(2.0 / frequencies.size) * waves.sum(axis=1))
