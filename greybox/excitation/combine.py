"""Signals made of signals: one that acts only at times, and the sum of several."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from greybox.excitation.signal import Array, Signal


@dataclass(frozen=True, kw_only=True)
class Windowed:
    """`signal` inside the windows (start, length) [s], zero outside, faded in and out over `fade`
    s."""

    signal: Signal
    windows: tuple[tuple[float, float], ...]
    fade: float = 0.1

    def __call__(self, time: Array, rng: np.random.Generator) -> Array:
        """Values at the times (N,); shape (N,)."""
        gate = np.zeros_like(time)
        for start, length in self.windows:
            since = time - start
            gate = np.maximum(
                gate, np.clip(np.minimum(since, length - since) / max(self.fade, 1e-9), 0.0, 1.0)
            )
        return np.asarray(gate * self.signal(time, rng))


@dataclass(frozen=True, kw_only=True)
class Total:
    """The sum of `signals`, each with random numbers of its own."""

    signals: tuple[Signal, ...]

    def __call__(self, time: Array, rng: np.random.Generator) -> Array:
        """Values at the times (N,); shape (N,)."""
        seeds = rng.integers(0, 2**63, size=len(self.signals))
        return np.sum(
            [s(time, np.random.default_rng(n)) for s, n in zip(self.signals, seeds)], axis=0
        )
