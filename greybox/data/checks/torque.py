"""Regression of angular acceleration on the commands: which rotor turns the craft which way, how strongly, how late.

d(omega)/dt = B (u_i^2, late by a lag) + E (a_x, a_y) + c, per axis. The lateral specific force stands for the velocity
of the craft (drag), whose moment would otherwise be read as a property of the rotors under feedback.
"""

from __future__ import annotations

import weakref
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from greybox.data.checks.signals import derivative, shifted, smoothed
from greybox.data.checks.view import FloatArray, View

HALF_WINDOW = 0.015
"""Rates are differentiated over twice this time [s]."""

CLEARLY = 1.2
"""An implausible lag must explain this many times as much as the best plausible one."""

LARGEST_LAG = 0.12
"""Lags from command to angular acceleration that a craft can have [s]."""

SEARCHED = (-0.2, 0.35)
"""Lags that are searched [s]: outside the plausible ones the streams are not on one clock."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Torque:
    """Per axis (roll, pitch, yaw) how the rotors turn the craft.

    `gains` (3, n) [rad/s^2 per u^2] of each rotor, `lag` (3,) [s] at which they explain most, `share` (3,) of variance
    that they explain beyond everything else, `thirds` (3, 3, n) the gains in each third of the flight. These use lags that
    a craft can have; `searched_lag` [s] and `searched_share` are the best of roll and pitch together over all lags, and
    `plausible_share` the best of these over the plausible ones.
    """

    gains: FloatArray
    lag: FloatArray
    share: FloatArray
    thirds: FloatArray
    searched_lag: float
    searched_share: float
    plausible_share: float

    @property
    def misaligned(self) -> bool:
        """Whether commands and motion fit clearly better at a lag that no craft has."""
        outside = not -1e-9 <= self.searched_lag <= LARGEST_LAG + 1e-9
        return outside and self.searched_share > CLEARLY * self.plausible_share and self.searched_share > 0.15


def _solve(x: FloatArray, y: FloatArray) -> FloatArray:
    """Least squares (k, 3); directions that the data hardly move (below 1 % of the largest) get no gain."""
    scale = np.maximum(np.linalg.norm(x, axis=0), 1e-300)
    return np.asarray(np.linalg.lstsq(x / scale, y, rcond=1e-2)[0] / scale[:, None], dtype=np.float64)


_KNOWN: weakref.WeakKeyDictionary[View, Torque | None] = weakref.WeakKeyDictionary()


def torque_regression(view: View) -> Torque | None:
    """The regression over the airborne part; None where fewer than 200 samples are complete."""
    if view not in _KNOWN:
        _KNOWN[view] = _regression(view)
    return _KNOWN[view]


def _regression(view: View) -> Torque | None:
    dt = view.dt
    half = max(1, round(HALF_WINDOW / dt))
    rate = view.group("rate")
    turn = derivative(rate, dt, half)
    u = smoothed(view.group("command") ** 2, half)
    n = u.shape[1]
    other = np.ones((u.shape[0], 1))
    if view.has("specific_force"):
        other = np.column_stack([smoothed(view.joined(["ax", "ay"]), 2 * half), other])
    lags = np.arange(round(SEARCHED[0] / dt), round(SEARCHED[1] / dt) + 1)
    known = np.isfinite(turn).all(axis=1) & np.isfinite(other).all(axis=1)
    for lag in (lags[0], 0, lags[-1]):
        known &= np.isfinite(shifted(u, int(lag))).all(axis=1)
    if known.sum() < 200:
        return None
    y = turn[known]
    total = ((y - y.mean(axis=0)) ** 2).sum(axis=0)
    rest = _without(other[known], y)
    base = (rest**2).sum(axis=0)
    shares, gains = np.zeros((len(lags), 3)), np.zeros((len(lags), 3, n))
    for i, lag in enumerate(lags):
        x = _without(other[known], shifted(u, int(lag))[known])
        b = _solve(x, rest)
        shares[i] = (base - ((rest - x @ b) ** 2).sum(axis=0)) / np.maximum(total, 1e-300)
        gains[i] = b.T
    plausible = np.flatnonzero((lags >= 0) & (lags * dt <= LARGEST_LAG + 1e-9))
    best = plausible[shares[plausible].argmax(axis=0)]
    thirds = np.zeros((3, 3, n))
    where = np.flatnonzero(known)
    for k, part in enumerate(np.array_split(np.arange(where.size), 3)):
        for axis in range(3):
            x = _without(other[where[part]], shifted(u, int(lags[best[axis]]))[where[part]])
            thirds[k, axis] = _solve(x, _without(other[where[part]], y[part]))[:, axis]
    axes = np.arange(3)
    both = shares[:, :2].mean(axis=1)
    return Torque(
        gains=gains[best, axes],
        lag=lags[best] * dt,
        share=shares[best, axes],
        thirds=thirds,
        searched_lag=float(lags[both.argmax()] * dt),
        searched_share=float(both.max()),
        plausible_share=float(both[plausible].max()),
    )


def _without(other: FloatArray, y: FloatArray) -> FloatArray:
    """What is left of y after regression on the other signals."""
    return y - other @ np.linalg.lstsq(other, y, rcond=None)[0]


def expected_signs(view: View) -> FloatArray:
    """Direction of the torque of each rotor, (3, n), rows roll, pitch, yaw, zero mean and unit length where not zero.

    Lift at (x, y) gives (y, -x); the drag torque of a rotor is -spin.
    """
    place = np.array([r.position for r in view.vehicle.rotors], dtype=np.float64)
    spin = np.array([r.spin for r in view.vehicle.rotors], dtype=np.float64)
    rows = np.stack([place[:, 1], -place[:, 0], -spin])
    return directions(rows)


def directions(rows: npt.NDArray[np.float64]) -> FloatArray:
    """Rows (..., n) without their mean, scaled to unit length (left at zero where they vanish)."""
    centred = rows - rows.mean(axis=-1, keepdims=True)
    length = np.linalg.norm(centred, axis=-1, keepdims=True)
    return np.where(length > 1e-12, centred / np.maximum(length, 1e-300), 0.0)
