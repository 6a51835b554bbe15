"""The 3-2-1-1 input: steps of alternating sign that last 3, 2, 1 and 1 units, a classic of
flight-test practice."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from greybox.excitation.signal import Array


@dataclass(frozen=True, kw_only=True)
class ThreeTwoOneOne:
    """Steps +, -, +, - of 3, 2, 1, 1 times `unit` s with the given amplitude, every `period` s from
    `start` on."""

    amplitude: float
    unit: float = 0.15
    period: float = 4.0
    start: float = 0.0

    def __call__(self, time: Array, rng: np.random.Generator) -> Array:
        """Values at the times (N,); shape (N,)."""
        since = time - self.start + 1e-9
        phase = np.mod(since, self.period) / self.unit
        shape = np.select(
            [phase < 3.0, phase < 5.0, phase < 6.0, phase < 7.0], [1.0, -1.0, 1.0, -1.0], 0.0
        )
        return np.asarray(np.where(since >= 0.0, self.amplitude * shape, 0.0))
