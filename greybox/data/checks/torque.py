"""Regression of angular acceleration on the commands: which rotor turns the craft which way, how
strongly, how late.

d(omega)/dt = B (u_i^2, late by a lag) + D omega + E (a_x, a_y) + c, per axis. Rates damp, and the
lateral specific force stands for the velocity of the craft (drag): their moments would otherwise be
read as a property of the rotors, or of a clock, under feedback. Gaps are joined up where they are
no longer than the span of a derivative, or than the pace of a slower stream. Without a gyro the
attitude shows the rates (`rates.py`).
"""

from __future__ import annotations

import weakref
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from greybox.data.checks.block_sums import BLOCKS, BlockSums
from greybox.data.checks.rates import body_rates, lateral_force, shown_by, windows
from greybox.data.checks.signals import derivative, joined_up, peak, shifted, smoothed
from greybox.data.checks.view import FloatArray, View
from greybox.data.drive import LATE_SPEEDS

CLEARLY = 1.2
"""An implausible lag must explain this many times as much as the best plausible one, ..."""
LEFT = 0.5
"""... or leave at most this share of what that one leaves."""

LARGEST_LAG = 0.12
"""Lags from command to angular acceleration that a craft can have [s]."""

LATE_POSE = 0.1
"""How much later still an attitude may show it [s]: a pose comes over a network, or out of a
filter."""

SEARCHED = (-0.2, 0.35)
"""Lags that are searched [s]: outside the plausible ones the streams are not on one clock."""


SEEN = 0.08
"""Share of the angular acceleration's variance that the commands must explain before a verdict on
roll and pitch."""

SEEN_YAW = 0.02
"""The same before one on yaw."""

LEAST = 200
"""Instants that must have commands, gyro or attitude, and specific force about them."""

BY_CHANCE = 2.0
"""What the best lag explains of noise is so many times what one lag does."""


ROUNDED = 1e-10
"""Share of a sum of squares that may be rounding, once nearly all of it was subtracted."""
EPS = 1e-14
"""Rounding of such a sum itself, as a share of it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Sums(BlockSums):
    """Sums of the regression per axis and block, of one flight or several: `xx` (3, B, n, n) of the
    squared commands, `xy` (3, B, n) of these and the angular acceleration. Everything else and the
    sum of the commands are taken out."""

    xx: FloatArray
    xy: FloatArray

    block_axis: ClassVar[int] = 1

    def gains(self) -> FloatArray:
        """Gains (3, B, n) [rad/s^2 per u^2], those of the sum of the commands left out."""
        return least_squares(self.xx, self.xy)

    def along(self, promised: FloatArray) -> FloatArray:
        """Gains (3, B) [rad/s^2 per u^2] of each axis along its promised direction (3, n), the
        other two beside it; NaN where the commands do not move along it at all."""
        turning = np.flatnonzero(promised.any(axis=1))
        some = promised[turning]
        xx = np.einsum("ki,abij,lj->abkl", some, self.xx, some)
        moved = (
            np.einsum("abkk->abk", xx) > ROUNDED * np.trace(self.xx, axis1=2, axis2=3)[..., None]
        )
        gains = least_squares(xx, np.einsum("ki,abi->abk", some, self.xy))
        out = np.full(self.xx.shape[:2], np.nan)
        for k, axis in enumerate(turning):
            out[axis] = np.where(moved[axis, :, k], gains[axis, :, k], np.nan)
        return out

    def agreement(self, promised: FloatArray) -> FloatArray:
        """Of what the commands explain, the share (3, B) that torques in the promised directions
        (3, n) explain, negative where they act the other way round."""
        most = np.einsum("abi,abi->ab", self.xy, self.gains())
        along = np.einsum("ai,abi->ab", promised, self.xy)
        size = np.einsum("ai,abij,aj->ab", promised, self.xx, promised)
        return np.sign(along) * along**2 / np.maximum(size * most, 1e-300)


def least_squares(xx: FloatArray, xy: FloatArray) -> FloatArray:
    """Coefficients (..., n) from sums of products x'x (..., n, n) and x'y (..., n).

    Only what is rounding is left out: a direction that moves little is known badly, which its
    standard error says; were it cut off, its coefficient would be a zero that nobody measured.
    """
    own = np.einsum("...ii->...i", xx)
    scale = np.sqrt(np.where(own > 0.0, own, np.inf))
    alike = xx / scale[..., None] / scale[..., None, :]
    inverse = np.linalg.pinv(alike, rcond=ROUNDED, hermitian=True)
    return np.asarray(np.einsum("...ij,...j->...i", inverse, xy / scale) / scale)


def _sums(
    u: FloatArray, rows: npt.NDArray[np.int64], lag: int, other: FloatArray, turn: FloatArray
) -> Sums:
    """Sums (1, B, ...) of one axis."""
    x = shifted(u, lag)[rows]
    basis = _basis(np.column_stack([other[rows], x.sum(axis=1)]))
    x, y = _without(basis, x), _without(basis, turn[rows, None])[:, 0]
    parts = np.array_split(np.arange(rows.size), BLOCKS)
    return Sums(
        xx=np.array([[x[p].T @ x[p] for p in parts]]), xy=np.array([[x[p].T @ y[p] for p in parts]])
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Torque:
    """Per axis (roll, pitch, yaw) how the rotors turn the craft.

    `gains` (3, n) [rad/s^2 per u^2] of each rotor, `lag` (3,) [s] at which they explain most,
    `share` (3,) of variance that they explain beyond everything else, `sums` of the regression over
    blocks of time. These use lags that a craft can have; `searched_lag` [s] and `searched_share`
    are the best of roll and pitch together over all lags, and `plausible_share` the best of these
    over the `plausible` ones, from the first to the second [s]. Of noise the commands would explain
    the share `chance`. Lags about as likely as that found lie `lag_error` (3,) [s] from it, rms.
    """

    gains: FloatArray
    lag: FloatArray
    share: FloatArray
    sums: Sums
    searched_lag: float
    searched_share: float
    plausible_share: float
    plausible: tuple[float, float] = (0.0, LARGEST_LAG)
    chance: float = 0.0
    lag_error: FloatArray = field(default_factory=lambda: np.zeros(3))

    @property
    def seen(self) -> npt.NDArray[np.bool_]:
        """Whether the commands explain enough of roll, pitch and yaw (3,) for a verdict."""
        return np.asarray(self.share >= np.maximum((SEEN, SEEN, SEEN_YAW), self.chance))

    @property
    def misaligned(self) -> bool:
        """Whether commands and motion fit clearly better at a lag that no craft has."""
        earliest, latest = self.plausible
        outside = not earliest - 1e-9 <= self.searched_lag <= latest + 1e-9
        more = self.searched_share > CLEARLY * self.plausible_share
        less = 1.0 - self.searched_share < LEFT * (1.0 - self.plausible_share)
        more = more and self.searched_share > self.plausible_share + self.chance
        return outside and (more or less) and self.searched_share > 0.15


def _solve(xx: FloatArray, xy: FloatArray, whole: FloatArray) -> FloatArray:
    """Least squares (L, k, 3) from L sums of products x'x (L, k, k) and x'y (L, k, 3) after
    regression on others; `whole` (L, k) are the sums of squares before it. Columns of which nothing
    is left get no gain, nor do directions that may be the rounding of what was subtracted."""
    own = np.diagonal(xx, axis1=1, axis2=2)
    left = own > ROUNDED * whole
    scale = np.sqrt(np.where(left, own, np.inf))
    taken = np.divide(whole, own, out=np.ones_like(own), where=left).max(axis=1, initial=1.0)
    alike = xx / scale[:, None, :] / scale[:, :, None]
    inverse = np.linalg.pinv(alike, rcond=np.maximum(ROUNDED, EPS * taken), hermitian=True)
    return np.asarray(inverse @ (xy / scale[:, :, None]) / scale[:, :, None])


_KNOWN: weakref.WeakKeyDictionary[View, Torque | None] = weakref.WeakKeyDictionary()


def torque_regression(view: View) -> Torque | None:
    """The regression over the airborne part; None where fewer than `LEAST` instants have all."""
    if view not in _KNOWN:
        _KNOWN[view] = _regression(view)
    return _KNOWN[view]


def _regression(view: View) -> Torque | None:
    """Over the window that shows most of the weaker of roll and pitch beyond chance: which rotor
    turns what is free in each, so that the choice prefers no order."""
    if not shown_by(view):
        return None
    found = [t for half in windows(view) if (t := _over(view, half)) is not None]
    return max(found, key=lambda t: float(t.share[:2].min()) - t.chance, default=None)


def _over(view: View, half: int) -> Torque | None:
    """The regression with rates that are taken and differentiated over twice `half` samples."""
    dt = view.dt
    rate, mean = body_rates(view, half)
    turn = derivative(rate, dt, half)
    # What drives the craft is averaged as its motion is.
    u = smoothed(smoothed(joined_up(view.drive, half) ** 2, half), mean)
    other = np.column_stack([smoothed(rate, half), np.ones(u.shape[0])])
    push = lateral_force(view, half)
    if push is not None:
        other = np.column_stack([push, other])
    lags = np.arange(round(SEARCHED[0] / dt), round(SEARCHED[1] / dt) + 1)
    known = np.isfinite(turn).all(axis=1) & np.isfinite(other).all(axis=1)
    for lag in (lags[0], 0, lags[-1]):
        known &= np.isfinite(shifted(u, int(lag))).all(axis=1)
    if known.sum() < LEAST:
        return None
    y = turn[known]
    total = ((y - y.mean(axis=0)) ** 2).sum(axis=0)
    basis = _basis(other[known])
    rest = _without(basis, y)
    rows = np.flatnonzero(known)
    shares, gains = _at_lags(u, rows, lags, basis, rest, total)
    earliest, latest = _plausible(view)
    times = np.asarray(lags * dt, dtype=np.float64)
    plausible = np.flatnonzero((times >= earliest - 1e-9) & (times <= latest + 1e-9))
    best = plausible[shares[plausible].argmax(axis=0)]
    sums = [
        _sums(u, np.flatnonzero(known), int(lags[best[axis]]), other, turn[:, axis])
        for axis in range(3)
    ]
    axes = np.arange(3)
    both = shares[:, :2].mean(axis=1)
    alone = len(rows) / (2 * half)  # rows within a window say the same
    return Torque(
        gains=gains[best, axes],
        lag=np.array([_between(shares[:, a], lags, int(best[a])) * dt for a in axes]),
        share=shares[best, axes],
        sums=Sums(xx=np.concatenate([s.xx for s in sums]), xy=np.concatenate([s.xy for s in sums])),
        searched_lag=float(lags[both.argmax()] * dt),
        searched_share=float(both.max()),
        plausible_share=float(both[plausible].max()),
        plausible=(earliest, latest),
        chance=BY_CHANCE * u.shape[1] / alone,
        lag_error=_lag_error(shares, times, times[best], alone),
    )


def _at_lags(
    u: FloatArray,
    rows: npt.NDArray[np.int64],
    lags: npt.NDArray[np.int64],
    basis: FloatArray,
    rest: FloatArray,
    total: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """(share (L, 3) of a sum of squares `total` (3,) that u (N, n), late by each lag, explains of
    what the `basis` of everything else leaves (M, 3) in these rows, its gains (L, 3, n))."""
    n = u.shape[1]
    xx, xy, own = (np.zeros((len(lags), *s)) for s in ((n, n), (n, 3), (n,)))
    level = u[rows].mean(axis=0)  # a constant is among the others; small numbers square exactly
    for i, lag in enumerate(lags):
        x = u.take(rows - lag, axis=0) - level
        told, whole = basis.T @ x, x.T @ x
        xx[i], xy[i], own[i] = whole - told.T @ told, x.T @ rest, np.diag(whole)
    b = _solve(xx, xy, own)  # all at once: one of them is as small as a call
    shares = (b * (2.0 * xy - xx @ b)).sum(axis=1) / np.maximum(total, 1e-300)
    return shares, b.swapaxes(1, 2)


def _lag_error(
    shares: FloatArray, times: FloatArray, lag: FloatArray, samples: float
) -> FloatArray:
    """How far (3,) [s] lags that are about as likely as the one found (3,) lie from it, by shares
    (L, 3) at all lags (L,) of so many independent samples."""
    likely = -0.5 * samples * np.log(np.clip(1.0 - shares, 1e-9, 1.0))
    likely = np.exp(likely - likely.max(axis=0))
    away = (times[:, None] - lag) ** 2
    return np.asarray(np.sqrt((likely * away).sum(axis=0) / likely.sum(axis=0)))


def _plausible(view: View) -> tuple[float, float]:
    """Lags from what drives the rotors to the motion [s] between which those of a log lie."""
    # A speed acts at once: what is between it and the motion is the clock of the log.
    earliest, latest = (0.0, LARGEST_LAG) if view.commanded else (-LATE_SPEEDS, LATE_SPEEDS)
    return earliest, latest + (LATE_POSE if shown_by(view) == "attitude" else 0.0)


def _between(scores: FloatArray, lags: npt.NDArray[np.int64], best: int) -> float:
    """The lag [samples] of the score `best`, or of the peak beside it."""
    near = slice(max(best - 1, 0), best + 2)
    return peak(scores[near], lags[near])[0]


def _basis(columns: FloatArray) -> FloatArray:
    """Orthonormal columns (N, k) that span these (N, j), k <= j."""
    basis, sizes = np.linalg.qr(columns)
    size = np.abs(np.diag(sizes))
    return np.asarray(basis[:, size > 1e-12 * size.max()])


def _without(basis: FloatArray, y: FloatArray) -> FloatArray:
    """What is left of y (N, m) after regression on what the basis (N, k) spans."""
    return y - basis @ (basis.T @ y)


def expected_signs(view: View) -> FloatArray:
    """Direction of the torque of each rotor, (3, n), rows roll, pitch, yaw, zero mean and unit
    length where not zero.

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
