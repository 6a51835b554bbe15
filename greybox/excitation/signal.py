"""What an excitation signal is: a function of time and of a random generator."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import numpy.typing as npt
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Signal(Protocol):
    """A scalar signal; members are frozen dataclasses whose amplitude carries the unit of the
    channel they excite."""

    def __call__(self, time: Array, rng: np.random.Generator) -> Array:
        """Values at the times (N,) [s]; shape (N,)."""
        ...


def active(time: Array, start: float, length: float | None) -> npt.NDArray[np.bool_]:
    """Mask (N,) of the times inside [start, start + length); no length means until the end."""
    mask = time >= start - 1e-9
    return mask if length is None else mask & (time < start + length - 1e-9)
