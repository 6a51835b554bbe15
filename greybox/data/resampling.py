"""Resampling: what conditioning and the readers of streams share when samples move to other rows."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
Kind = TypeVar("Kind", bound=np.generic)

STRETCH = 2.5
"""Nothing is interpolated over a step longer than this many sample times of the log."""

AVERAGE_FROM = 1.5
"""A grid coarser than this many sample times of the log averages instead of picking."""


def held(t: FloatArray, values: npt.NDArray[Kind], grid: FloatArray) -> npt.NDArray[Kind]:
    """The last value at or before each grid point, (M,)."""
    return values[np.clip(np.searchsorted(t, grid, side="right") - 1, 0, t.size - 1)]


def continuous_signs(quaternions: FloatArray) -> tuple[FloatArray, int]:
    """Quaternions (N, 4) with signs such that neighbours agree (missing rows skipped); how many
    changes that took."""
    out = quaternions.copy()
    known = np.flatnonzero(np.isfinite(out).all(axis=1))
    if known.size < 2:
        return out, 0
    agree = np.sign(np.sum(out[known[1:]] * out[known[:-1]], axis=1))
    sign = np.concatenate([[1.0], np.cumprod(np.where(agree < 0, -1.0, 1.0))])
    out[known] *= sign[:, None]
    return out, int((np.diff(sign) != 0).sum())
