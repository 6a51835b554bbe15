"""Samples of an irregular clock, or of another rate, on a uniform grid.

At about the log's own rate measurements are interpolated linearly and commands held; at a lower
rate both are averaged over one sample time (measurements centred on the sample, commands over the
interval in which the sample is held).
"""

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


def _bracket(t: FloatArray, grid: FloatArray) -> npt.NDArray[np.int64]:
    return np.clip(np.searchsorted(t, grid, side="right") - 1, 0, t.size - 2)


def interpolated(t: FloatArray, values: FloatArray, grid: FloatArray, *, step: float) -> FloatArray:
    """Linear interpolation of (N,) at `grid` (M,); NaN where a neighbour is missing or the rows are
    too far apart."""
    if np.isfinite(values).mean() < 0.5:
        return _nearest(t, values, grid)
    i = _bracket(t, grid)
    width = t[i + 1] - t[i]
    weight = np.clip((grid - t[i]) / width, 0.0, 1.0)
    out = np.where(
        weight == 0.0,
        values[i],
        np.where(weight == 1.0, values[i + 1], (1 - weight) * values[i] + weight * values[i + 1]),
    )
    return np.where((width > STRETCH * step) & (weight > 0) & (weight < 1), np.nan, out)


def _nearest(t: FloatArray, values: FloatArray, grid: FloatArray) -> FloatArray:
    """A slow channel: each value goes to the grid point next to it, all other points stay
    missing."""
    out = np.full(grid.size, np.nan)
    known = np.flatnonzero(np.isfinite(values))
    place = np.rint((t[known] - grid[0]) / (grid[1] - grid[0])).astype(np.int64)
    inside = (place >= 0) & (place < grid.size)
    out[place[inside]] = values[known[inside]]
    return out


def held(t: FloatArray, values: npt.NDArray[Kind], grid: FloatArray) -> npt.NDArray[Kind]:
    """The last value at or before each grid point, (M,)."""
    return values[np.clip(np.searchsorted(t, grid, side="right") - 1, 0, t.size - 1)]


def averaged(
    t: FloatArray, values: FloatArray, grid: FloatArray, *, step: float, ahead: bool, linear: bool
) -> FloatArray:
    """Mean over one grid step, (M,), of the held or piecewise linear signal.

    The step lies after the grid point (`ahead`, for commands) or around it. NaN where less than
    half of it is known.
    """
    dt = grid[1] - grid[0]
    width = np.diff(t)
    known = np.isfinite(values[:-1]) & np.isfinite(values[1:]) & (width <= STRETCH * step)
    start = np.where(known, values[:-1], 0.0)
    slope = np.where(known, np.diff(values) / width, 0.0) if linear else np.zeros(width.size)
    area = np.concatenate([[0.0], np.cumsum(start * width + 0.5 * slope * width**2)])
    cover = np.concatenate([[0.0], np.cumsum(np.where(known, width, 0.0))])

    def up_to(at: FloatArray) -> tuple[FloatArray, FloatArray]:
        at = np.clip(at, t[0], t[-1])
        i = _bracket(t, at)
        s = at - t[i]
        return area[i] + start[i] * s + 0.5 * slope[i] * s**2, cover[i] + np.where(known[i], s, 0.0)

    begin = grid if ahead else grid - 0.5 * dt
    (area1, cover1), (area0, cover0) = up_to(begin + dt), up_to(begin)
    length = cover1 - cover0
    enough = length >= 0.5 * dt * (1 - 1e-9)
    return np.where(enough, (area1 - area0) / np.where(enough, length, 1.0), np.nan)


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
