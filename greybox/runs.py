"""Runs: where a condition holds without a break."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def runs(good: npt.NDArray[np.bool_]) -> list[tuple[int, int]]:
    """(start, stop) of the runs of True in `good` (N,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], good, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
