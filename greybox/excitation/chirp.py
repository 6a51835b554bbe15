"""Chirp: a sine whose frequency sweeps, spending the same number of cycles in every octave."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from greybox.excitation.signal import Array, active


@dataclass(frozen=True, kw_only=True)
class Chirp:
    """Logarithmic sweep from `low` to `high` Hz over `length` s from `start` on, zero outside; ends
    are tapered."""

    amplitude: float
    low: float = 0.2
    high: float = 10.0
    start: float = 0.0
    length: float = 20.0

    def __call__(self, time: Array, rng: np.random.Generator) -> Array:
        """Values at the times (N,); shape (N,)."""
        since = time - self.start
        ratio = np.log(self.high / self.low)
        inside = np.clip(since, 0.0, self.length)
        phase = (
            2.0 * np.pi * self.low * self.length / ratio * np.expm1(inside / self.length * ratio)
        )
        taper = np.clip(np.minimum(inside, self.length - inside) / (0.05 * self.length), 0.0, 1.0)
        return np.asarray(
            np.where(
                active(time, self.start, self.length), self.amplitude * taper * np.sin(phase), 0.0
            )
        )
