"""The delay of the gyro against the attitude over a flight, and what its estimates are worth.

Nearly constant rates tell no delay: their estimate is then where the noises happen to be alike. A
delay moves what the attitude foretells by its slope times the delay, so that least squares know it
to within the noise over what of the slopes gyro and attitude have in common. How far the clocks
wander is what windows differ by beyond these errors (the moments of DerSimonian and Laird,
Controlled Clinical Trials 7(3), 1986).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from greybox.data.checks.signals import (
    IntArray,
    attitude_joined_up,
    attitude_rate,
    bridged,
    centred,
    pace,
    peak,
    shifted,
    smoothed,
    windowed,
)
from greybox.data.checks.view import FloatArray, View

WINDOW = 2.0
"""Length of a window [s]."""

LARGEST = 0.3
"""Largest delay that is looked for [s]."""

CREDIBLE = 0.7
"""Correlation from which a window counts."""

HALF_WINDOW = 0.02
"""Rates are compared as means over twice this time [s]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Delays:
    """How late the gyro is against the attitude, window by window: `time` (K,) [s] of the middle,
    `late` (K,) [samples], `error` (K,) [samples], its standard error (infinite where the rates do
    not tell it). `mounting` (3, 3) took the attitude's rates to the gyro's axes."""

    time: FloatArray
    late: FloatArray
    error: FloatArray
    mounting: FloatArray

    @property
    def count(self) -> int:
        """Number of windows."""
        return int(self.late.size)

    def against(self, other: Delays) -> Delays:
        """By how much these are later than others, in the windows that tell both: clocks may wander
        meanwhile."""
        _, a, b = np.intersect1d(self.time, other.time, return_indices=True)
        return Delays(
            time=self.time[a],
            late=self.late[a] - other.late[b],
            error=np.hypot(self.error[a], other.error[b]),
            mounting=self.mounting,
        )

    def _weights(self, variance: float) -> FloatArray:
        return np.asarray(1.0 / np.maximum(self.error**2 + variance, 1e-12))

    @property
    def wandering(self) -> float:
        """Variance [samples^2] of the delay beyond what the errors make; 0 where there is none."""
        w = self._weights(0.0)
        total = float(w.sum())
        spare = total - float((w**2).sum()) / total if total > 0 else 0.0
        if spare <= 1e-9 * total:
            return 0.0
        middle = float(w @ self.late) / total
        excess = float(w @ (self.late - middle) ** 2) - (self.count - 1)
        return max(excess / spare, 0.0)

    @property
    def weights(self) -> FloatArray:
        """Weight (K,) of each window, of sum one; zero for all where nothing tells the delay."""
        w = self._weights(self.wandering)
        return w / max(float(w.sum()), 1e-300)

    def middle_error(self, *, wandering: bool = True) -> float:
        """Standard error [samples] of the delay in the middle of the flight, for clocks that wander
        as these do, or for steady ones: by what the rates tell alone."""
        total = float(self._weights(self.wandering if wandering else 0.0).sum())
        return total**-0.5 if total > 0 else float("inf")

    def quantile(self, share: float) -> float:
        """Delay [samples] below which lies this share of the weight, between windows too."""
        order = np.argsort(self.late)
        w = self.weights[order]
        reached = np.cumsum(w) - 0.5 * w
        return float(np.interp(share * float(w.sum()), reached, self.late[order]))

    @property
    def drift(self) -> tuple[float, float]:
        """(low, high) [samples] between which four fifths of the weight lie; the middle twice where
        the windows differ by no more than their errors."""
        if self.wandering == 0.0:
            return self.quantile(0.5), self.quantile(0.5)
        return self.quantile(0.1), self.quantile(0.9)

    @property
    def slope(self) -> float:
        """How much later the gyro becomes [samples/s]; 0 for fewer than three windows, and where
        the windows differ by no more than their errors."""
        if self.count < 3 or self.wandering == 0.0:
            return 0.0
        since = self.time - self.time[0]
        return float(np.polyfit(since, self.late, 1, w=np.sqrt(self.weights))[0])


def delays(
    view: View, axes: Sequence[int] = (0, 1, 2), mounting: FloatArray | None = None
) -> Delays:
    """The delay in every window in which gyro and attitude are alike about these body axes.

    A gyro that is turned against the attitude shows of each axis some of the others, which are
    early or late: `mounting` (3, 3) turns the attitude's rates to its axes, by default as the
    flight tells it.
    """
    half = max(1, round(HALF_WINDOW / view.dt))
    gyro = smoothed(bridged(view.group("rate"), half), half)
    rate = attitude_rate(attitude_joined_up(view.group("attitude"), 2 * half), view.dt, half)
    if mounting is not None:
        return _in_windows(view, gyro, rate @ mounting.T, list(axes), mounting)
    told = _in_windows(view, gyro, rate, [0, 1, 2], np.eye(3))
    if not told.count:
        return _in_windows(view, gyro, rate, list(axes), np.eye(3))
    mounting = _mounting(gyro, shifted(rate, round(told.quantile(0.5))))
    return _in_windows(view, gyro, rate @ mounting.T, list(axes), mounting)


def _mounting(gyro: FloatArray, rate: FloatArray) -> FloatArray:
    """The rotation (3, 3) that takes rates (N, 3) to those of the gyro, by least squares (Kabsch,
    Acta Crystallographica A 32, 1976)."""
    known = np.isfinite(np.column_stack([gyro, rate])).all(axis=1)
    if not known.any():
        return np.eye(3)
    left, _, right = np.linalg.svd(centred(gyro[known]).T @ centred(rate[known]))
    left[:, 2] *= np.sign(np.linalg.det(left @ right))
    return np.asarray(left @ right)


def _in_windows(
    view: View, gyro: FloatArray, rate: FloatArray, axes: Sequence[int], mounting: FloatArray
) -> Delays:
    """The delays about axes of the gyro that the rates (N, 3) of both tell."""
    half = max(1, round(HALF_WINDOW / view.dt))
    gyro, rate = gyro[:, axes], rate[:, axes]
    alone = 2 * half + pace(view.group("attitude"))  # rows whose means have noise in common
    length, reach = round(WINDOW / view.dt), round(LARGEST / view.dt)
    time = view.time
    lags = np.arange(-reach, reach + 1)
    starts = np.arange(0, max(rate.shape[0] - length, 0) + 1, max(length // 2, 1))
    there = np.concatenate([[0], np.cumsum(np.isfinite(rate).all(axis=1))])
    starts = starts[starts + length <= rate.shape[0]]
    starts = starts[there[starts + length] - there[starts] >= 0.8 * length]
    out = []
    # The noisier stream stands still: over others of its samples the correlation is another one.
    told = windowed(rate, gyro, lags, starts, length)[:, ::-1]
    for start, scores in zip(starts, told, strict=True):
        late, top = peak(scores, lags)
        if top >= CREDIBLE and abs(late) < reach:
            rows = slice(int(start), int(start) + length)
            error = _error(gyro, rate, rows, round(late), half, alone)
            error = max(error, _spread(scores, lags, late, len(axes) * length / alone))
            out.append((float(np.nanmean(time[rows])), late, error))
    found = np.array(out).reshape(-1, 3)
    return Delays(time=found[:, 0], late=found[:, 1], error=found[:, 2], mounting=mounting)


def _spread(scores: FloatArray, lags: IntArray, late: float, samples: float) -> float:
    """How far [samples] lags that are about as likely as the one found lie from it, rms, by the
    correlations (L,) of so many independent samples.

    The correlation may be nearly as high at another lag: the slopes at the highest do not tell.
    """
    alike = np.clip(scores, 0.0, 1.0 - 1e-9)
    chance = -0.5 * samples * np.log(1.0 - alike**2)
    chance = np.exp(chance - chance.max())
    return float(np.sqrt(chance @ (lags - late) ** 2 / chance.sum()))


def _error(
    gyro: FloatArray, rate: FloatArray, rows: slice, late: int, half: int, alone: int
) -> float:
    """Standard error [samples] of the delay in these rows, as far as the slopes tell it.

    Sizes mean nothing. The noise of both is alike over `alone` rows. It makes the slopes of each
    stream larger, but not what they have in common.
    """
    first, last = max(rows.start - half, 0), rows.stop + half
    y, x = gyro[first:last], shifted(rate, late)[first:last]
    four = (y, x, _slope(x, half), _slope(y, half))
    known = np.isfinite(np.column_stack(four)).all(axis=1)
    y, x, slope, other = (centred(v[known]) for v in four)
    common = float((slope * other).sum())
    if common <= 0.0:
        return float("inf")
    size = np.sqrt((y**2).sum() / (x**2).sum())
    noise = float(((y - size * x) ** 2).mean()) * alone
    return float(np.sqrt(noise * (slope**2).sum() / slope.shape[1])) / common


def _slope(values: FloatArray, half: int) -> FloatArray:
    """Change (N, 3) per sample, over twice `half` samples."""
    return (shifted(values, -half) - shifted(values, half)) / (2 * half)
