"""The attitude as the gyro has it: a witness where attitude and accelerometer disagree.

An estimator's attitude errs with the motion, as it takes the pull of the rotors for gravity, and
then another reading of the accelerometer may fit better than the right one. The gyro knows how the
craft turned, and over some seconds nothing else.
"""

from __future__ import annotations

import numpy as np

from greybox.data.checks.signals import (
    BoolArray,
    FloatArray,
    attitude_joined_up,
    attitude_rate,
    bridged,
)
from greybox.frames import numeric

HALF_WINDOW = 5.0
"""The gyro's turn is led to the attitude that was logged by means over twice this time [s]: its bias
drifts more slowly, and what takes an attitude away is over sooner."""


def by_gyro(quaternions: FloatArray, gyro: FloatArray, dt: float, most: int) -> FloatArray:
    """Attitude (N, 4) by the integral of the gyro (N, 3) [rad/s], led slowly to the quaternions
    (N, 4); missing where one of them is over more than `most` rows."""
    q, rate = attitude_joined_up(quaternions, most), bridged(gyro, most)
    out = np.full(q.shape, np.nan)
    apart = rate - attitude_rate(q, dt, 1)
    if not np.isfinite(apart).all(axis=1).any():
        return out
    own = _turned(q, rate - np.nanmean(apart, axis=0), dt)
    known: BoolArray = np.asarray(np.isfinite(own).all(axis=1) & np.isfinite(q).all(axis=1))
    if not known.any():
        return out
    back = own * np.array([1.0, -1.0, -1.0, -1.0])
    error = np.zeros((len(q), 3))
    error[known] = numeric("log", numeric("multiply", q[known], back[known]))
    slow = _means(error, known, round(HALF_WINDOW / dt))
    out[known] = numeric("multiply", numeric("exp", slow[known]), own[known])
    return out


def _turned(q: FloatArray, rate: FloatArray, dt: float) -> FloatArray:
    """The attitude (N, 4) that a rate (N, 3) makes of the first of every stretch in which both are
    known."""
    steps = 0.5 * (rate[1:] + rate[:-1]) * dt
    known: BoolArray = np.asarray(np.isfinite(q).all(axis=1) & np.isfinite(rate).all(axis=1))
    there = known[1:] & known[:-1]
    turn = np.tile([1.0, 0.0, 0.0, 0.0], (len(steps), 1))
    turn[there] = numeric("exp", steps[there])
    out = np.full(q.shape, np.nan)
    w = x = y = z = 0.0
    for k in np.flatnonzero(known).tolist():
        if k and there[k - 1]:
            a, b, c, d = turn[k - 1].tolist()
            w, x, y, z = (
                w * a - x * b - y * c - z * d,
                w * b + x * a + y * d - z * c,
                w * c - x * d + y * a + z * b,
                w * d + x * c - y * b + z * a,
            )
        else:
            w, x, y, z = q[k].tolist()
        out[k] = w, x, y, z
    return out


def _means(values: FloatArray, known: BoolArray, half: int) -> FloatArray:
    """Means (N, k) over the known rows within `half` rows, fewer at the ends."""
    rows = np.arange(len(values))
    first, last = np.maximum(rows - half, 0), np.minimum(rows + half + 1, len(values))
    total = np.vstack([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    count = np.concatenate([[0], np.cumsum(known)])
    return np.asarray(
        (total[last] - total[first]) / np.maximum(count[last] - count[first], 1)[:, None]
    )
