"""Doublets: a step up and a step down of the same length, repeated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from greybox.excitation.signal import Array


@dataclass(frozen=True, kw_only=True)
class Doublets:
    """+amplitude for `width` s, -amplitude for `width` s, then rest; every `period` s from `start`
    on.

    With `alternate` every second doublet starts downwards.
    """

    amplitude: float
    width: float = 0.2
    period: float = 2.0
    start: float = 0.0
    alternate: bool = True

    def __call__(self, time: Array, rng: np.random.Generator) -> Array:
        """Values at the times (N,); shape (N,)."""
        since = time - self.start + 1e-9
        number, phase = np.divmod(since, self.period)
        shape = np.where(phase < self.width, 1.0, np.where(phase < 2.0 * self.width, -1.0, 0.0))
        sign = np.where(number % 2 == 1, -1.0, 1.0) if self.alternate else 1.0
        return np.asarray(np.where(since >= 0.0, self.amplitude * sign * shape, 0.0))
