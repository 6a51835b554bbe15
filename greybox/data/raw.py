"""RawLog: a log in canonical channels on its own, unchecked clock, and what was removed from one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Removed:
    """Samples of one channel group in one flight that were taken as missing."""

    flight: str
    channels: tuple[str, ...]
    count: int
    worst: float
    first_time: float
    reason: str

    def line(self) -> str:
        """For a terminal."""
        names = ", ".join(self.channels)
        return (
            f"{self.flight}: {self.count} sample(s) of {names} taken as missing ({self.reason}; "
            f"the worst {self.worst:.4g}, the first at t = {self.first_time:.2f} s)"
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class RawLog:
    """Canonical channels (SI, right signs) on the clock of the log, which may still jitter, stop or go back.

    `t` (N,) finite [s]; `channels` name -> (N,), NaN = missing; `extra` unknown columns as they came; `rows` (N,) line
    numbers in the file; `empty` canonical channels whose column holds no value; `notes` what the reader has to say;
    `removed` the samples that were taken as missing because no craft can have made them.
    """

    t: FloatArray
    channels: Mapping[str, FloatArray]
    extra: Mapping[str, npt.NDArray[Any]]
    rows: npt.NDArray[np.int64]
    flight: str
    source: str
    sha256: str
    noncausal: frozenset[str] = frozenset()
    empty: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    removed: tuple[Removed, ...] = ()

    @property
    def n(self) -> int:
        """Number of rows."""
        return int(self.t.size)
