"""Which way a specific force points: along the thrust, but where gravity was taken out."""

from __future__ import annotations

import numpy as np

from greybox.data.raw import FloatArray

STRAIGHT = 0.6
"""Straightness below which no lasting direction is seen."""


def straightness(force: FloatArray) -> float:
    """Length of the mean of a specific force (N, 3) over its usual length: 1 where it always points
    the same way, 0 without samples."""
    known = force[np.isfinite(force).all(axis=1)]
    size = float(np.median(np.linalg.norm(known, axis=1))) if known.size else 0.0
    return float(np.linalg.norm(known.mean(axis=0))) / size if size > 0 else 0.0


def axis_of_thrust(force: FloatArray) -> str:
    """The axis along which a specific force (N, 3) points on average: "+z" where it is ours, ""
    where it has no lasting direction, as without gravity."""
    if straightness(force) < STRAIGHT:
        return ""
    mean = force[np.isfinite(force).all(axis=1)].mean(axis=0)
    axis = int(np.argmax(np.abs(mean)))
    return f"{'-' if mean[axis] < 0 else '+'}{'xyz'[axis]}"
