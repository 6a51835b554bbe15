"""Random steps: a level held for a random time, then another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from greybox.excitation.signal import Array


@dataclass(frozen=True, kw_only=True)
class RandomSteps:
    """Levels drawn uniformly from [-amplitude, amplitude], each held between `shortest` and
    `longest` s."""

    amplitude: float
    shortest: float = 0.5
    longest: float = 2.0

    def __call__(self, time: Array, rng: np.random.Generator) -> Array:
        """Values at the times (N,); shape (N,)."""
        out, begin = np.zeros_like(time), float(time[0])
        while begin <= time[-1]:
            length = rng.uniform(self.shortest, self.longest)
            out[(time >= begin) & (time < begin + length)] = self.amplitude * rng.uniform(-1.0, 1.0)
            begin += length
        return out
