"""Gain and lag of a measured frequency response: the low-order form that flight tests quote.

    H(s) = gain exp(-s d) / ((1 + T s) s^(n-1) (s + corner)),   lag = d + T,   n = 0 (no corner), 1, 2

(low-order equivalent system; Tischler and Remple 2012, chapter 11: magnitude and phase weighed by
their errors.) `lag` is the slope of the phase beyond that of the integrators, at low frequency:
delays, rotor lag and filters in one number, which flights tell better than its parts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypedDict

import numpy as np
import numpy.typing as npt
import scipy.optimize

from greybox.symbolic import BoolArray, FloatArray

FEWEST = 6
"""Frequencies that a fit needs."""
APART = 2.0
"""Ratio of neighbouring frequencies from which on they are not one band."""
LEAST_ERROR = 0.02
"""Relative error that no estimate is believed to be below: the form is not exact."""
LONGEST = 0.5
"""Lags beyond [s] are not looked for."""
SLOWEST = 0.15
"""Largest T [s]: a slower one is the corner of an integrator, not a rotor."""
UNTOLD = 0.5
"""Relative error of a gain that may as well be none."""
ROUNDED = 1e-13
"""Eigenvalue of slopes of unit length that rounding leaves of none."""
GUESSES = np.arange(-0.1, 0.3, 0.004)
"""Lags [s] to start from: the one that straightens the phase tells which turns belong to it."""


class LagAndGainRow(TypedDict):
    """A `LagAndGain` in a result file."""

    lag: float
    lag_std: float
    gain: float
    gain_std: float
    corner: float
    integrators: int
    low: float
    high: float


@dataclass(frozen=True, kw_only=True)
class LagAndGain:
    """`lag` [s] and `gain` (output unit / s^integrators per input unit, with its sign) with their
    standard errors, `corner` [rad/s], fitted to frequencies `low` to `high` [Hz]."""

    lag: float
    lag_std: float
    gain: float
    gain_std: float
    corner: float
    integrators: int
    low: float
    high: float

    def to_dict(self) -> LagAndGainRow:
        """Plain values under the names of the fields."""
        return {
            "lag": self.lag,
            "lag_std": self.lag_std,
            "gain": self.gain,
            "gain_std": self.gain_std,
            "corner": self.corner,
            "integrators": self.integrators,
            "low": self.low,
            "high": self.high,
        }


def lag_and_gain(
    frequency: FloatArray,
    value: npt.NDArray[np.complex128],
    error: FloatArray,
    usable: BoolArray,
    integrators: int | None = None,
) -> LagAndGain | None:
    """The form at the `usable` (K,) frequencies [Hz] of the widest band, with a loss that stray
    ones hardly move; `integrators` between input and output, or the number that fits best. None
    where there are too few frequencies, or these do not tell the gain: far above the corner of a
    rotor, twice the gain with twice the lag looks the same."""
    places = np.flatnonzero(usable)
    cuts = np.flatnonzero(np.diff(np.log(frequency[places])) > np.log(APART)) + 1
    one = max(np.split(places, cuts), key=len)
    if one.size < FEWEST:
        return None
    f, h, std = frequency[one], value[one], error[one]
    orders = (0, 1, 2) if integrators is None else (integrators,)
    found = [_fitted(f, h, std, n) for n in orders]
    best = min(found, key=lambda pair: pair[0])[1]
    return best if best.gain_std < UNTOLD * abs(best.gain) else None


def _fitted(
    f: FloatArray, value: npt.NDArray[np.complex128], error: FloatArray, n: int
) -> tuple[float, LagAndGain]:
    """(robust cost, form) with `n` integrators, one of them with a corner."""
    omega = 2 * np.pi * f
    size = np.log(np.abs(value))
    sigma = np.maximum(error / np.abs(value), LEAST_ERROR)
    begin = -0.5 * np.pi * n + np.array([0.0, np.pi])
    straight = np.angle(value) - begin[:, None, None] + omega * GUESSES[:, None]
    straight = (straight + np.pi) % (2 * np.pi) - np.pi
    cost = np.sum(np.sqrt(1 + (straight / sigma) ** 2), axis=-1)
    side, guess = (int(i) for i in np.unravel_index(np.argmin(cost), cost.shape))
    sign, start_lag = 1 - 2 * side, float(GUESSES[guess])
    turn = straight[side, guess] - omega * start_lag - 0.5 * np.pi * n

    def residual(theta: FloatArray) -> FloatArray:
        (gain, lag), t = theta[:2], np.exp(theta[2])
        log_size = gain - 0.5 * np.log1p((omega * t) ** 2)
        phase = -0.5 * np.pi * n - omega * (lag - t) - np.arctan(omega * t)
        if n:
            corner = np.exp(theta[3])
            log_size = log_size - 0.5 * np.log(omega**2 + corner**2) - (n - 1) * np.log(omega)
            phase = phase + np.arctan(corner / omega)
        return np.concatenate([(size - log_size) / sigma, (turn - phase) / sigma])

    low_end = float(omega[0])
    start = [float(np.median(size + n * np.log(omega))), start_lag, np.log(0.01)] + [
        np.log(low_end / 2)
    ] * (n > 0)
    low = [-np.inf, -LONGEST, np.log(1e-4)] + [np.log(1e-2)] * (n > 0)
    # A corner above the low end would be a second lag under another name.
    high = [np.inf, LONGEST, np.log(SLOWEST)] + [np.log(max(2 * low_end, 0.1))] * (n > 0)
    done = scipy.optimize.least_squares(
        residual,
        np.clip(start, low, high),
        bounds=(low, high),
        loss="soft_l1",
        x_scale=[1.0, 0.02, 1.0] + [1.0] * (n > 0),
    )
    r, j = residual(done.x), done.jac
    free = max(r.size - done.x.size, 1)
    # The median of squares tells the scatter without the stray ones; 0.455 is that of chi-square.
    scatter = max(1.0, float(np.median(r**2)) / 0.455 * r.size / free)
    std = _errors(j, done.active_mask != 0) * np.sqrt(scatter)
    gain = sign * float(np.exp(done.x[0]))
    return float(done.cost), LagAndGain(
        lag=float(done.x[1]),
        lag_std=float(std[1]),
        gain=gain,
        gain_std=abs(gain) * float(std[0]),
        corner=float(np.exp(done.x[3])) if n else 0.0,
        integrators=n,
        low=float(f[0]),
        high=float(f[-1]),
    )


def _errors(jacobian: FloatArray, held: BoolArray) -> FloatArray:
    """Standard errors (P,) of unit residuals by their slopes (R, P); 0 of what is `held` at a bound
    or without effect. What the residuals do not tell apart is uncertain, up to rounding."""
    size = np.linalg.norm(jacobian, axis=0)
    open_ = (size > 0) & ~held
    told, ways = np.linalg.eigh((unit := jacobian[:, open_] / size[open_]).T @ unit)
    out = np.zeros(size.size)
    out[open_] = np.sqrt((ways**2 / np.maximum(told, ROUNDED)).sum(axis=1)) / size[open_]
    return out
