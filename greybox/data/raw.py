"""RawLog: a log in canonical channels on its own, unchecked clock."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class RawLog:
    """Canonical channels (SI, right signs) on the clock of the log, which may still jitter, stop or go back.

    `t` (N,) finite [s]; `channels` name -> (N,), NaN = missing; `extra` unknown columns as they came; `rows` (N,) line
    numbers in the file; `empty` canonical channels whose column holds no value; `notes` what the reader has to say.
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

    @property
    def n(self) -> int:
        """Number of rows."""
        return int(self.t.size)
