"""Whether a craft stands although its motors push as in flight: whether it keeps stiller than a body
that is free to follow them.

In flight the torques of the commands turn a craft: its rates are, up to a line, the integral of the
squared commands, late by a lag, times gains that the log itself shows. On the ground the floor takes
the torques up, and a gyro shows its noise alone. A hover without noise is asked nothing, and not
told. Where drag or wind take up what is asked the craft does not follow either, but moves; how still
it keeps is therefore compared with every stretch of flight that is as long.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from greybox.frames import numeric

FloatArray = npt.NDArray[np.float64]

FEWEST = 4
"""Stretches of flight with which one on the ground is compared, at the least."""
LAGS = np.arange(0.0, 0.13, 0.02)
"""Lags of the motion behind what drives it that are tried [s]."""
MEAN = 0.05
"""The motion is alike in two neighbouring means over so long [s], the noise of a sensor is not."""
CLEAR = 3.0
"""Standard errors by which a craft must follow less, and keep stiller."""
FOLLOWS = 0.5
"""A craft that turns by less than this share of what is asked does not follow."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """What shows the turns of a craft beside what drives it, at times `t` (N,) [s]: `squared`
    (N, n), the driving channels less their mean, and `turned` (N, 3), rates (`order` 1) or angles
    (`order` 2)."""

    t: FloatArray
    squared: FloatArray
    turned: FloatArray
    order: int

    def rows(self, first: float, last: float) -> slice:
        """The rows of these times [s]."""
        return slice(*np.searchsorted(self.t, [first, last]).tolist())

    def asked(self, lag: float) -> FloatArray:
        """What is asked (N, n) from the first row on, `lag` [s] after what drives the craft."""
        columns = [np.interp(self.t - lag, self.t, column) for column in self.squared.T]
        asked = np.column_stack(columns)
        for _ in range(self.order):
            asked = np.cumsum(asked * np.diff(self.t, prepend=self.t[0])[:, None], axis=0)
        return asked

    def piece(self, rows: slice) -> Piece:
        """These rows alone."""
        t = self.t[rows]
        beside = np.vander((t - t[0]) / (t[-1] - t[0]), self.order + 1)
        return Piece(rows=rows, beside=np.linalg.qr(beside)[0])


@dataclass(frozen=True, kw_only=True, eq=False)
class Piece:
    """Some rows of a motion, where a constant torque and an unknown start add what `beside` (M,
    order + 1) spans."""

    rows: slice
    beside: FloatArray

    def of(self, values: FloatArray) -> FloatArray:
        """Values (N, k) in these rows, without what is beside them, (M, k)."""
        own = values[self.rows]
        return np.asarray(own - self.beside @ (self.beside.T @ own))


def motion_of(
    t: FloatArray, driving: FloatArray, channels: Mapping[str, FloatArray]
) -> Motion | None:
    """The motion by the gyro, else by the attitude, where `driving` (N, n) are known at times `t`
    (N,); None where a log has neither."""
    for names, order in ((("p", "q", "r"), 1), (("qw", "qx", "qy", "qz"), 2)):
        if all(n in channels for n in names):
            turned = np.column_stack([channels[n] for n in names])
            known = np.isfinite(turned).all(axis=1)
            if known.sum() < 2:
                return None
            turned = turned[known]
            if order == 2:
                steps = numeric("difference", turned[:-1], turned[1:])
                turned = np.vstack([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
            squared = driving[known] ** 2
            squared = squared - squared.mean(axis=1, keepdims=True)
            return Motion(t=t[known], squared=squared, turned=turned, order=order)
    return None


def stiller_than_in_flight(
    motion: Motion, stretch: tuple[float, float], flight: tuple[float, float]
) -> bool:
    """Whether in a `stretch` of time [s] the craft does not follow its commands, and keeps clearly
    stiller for what they ask than in any stretch of the `flight` [s] that is as long."""
    length = stretch[1] - stretch[0]
    rows = motion.rows(*stretch)
    count = rows.stop - rows.start
    starts = np.arange(flight[0], flight[1] - length, 0.5 * length)
    others = [motion.rows(s, s + length) for s in starts]
    others = [r for r in others if 2 * (r.stop - r.start) > count]  # no gap
    width = max(1, round(MEAN * count / length))
    if len(others) < FEWEST or count < 3 * width:
        return False
    flown = [motion.piece(r) for r in others]
    moved = [p.of(motion.turned) for p in flown]
    _, gains, late = min(
        (_fitted(motion.asked(lag), flown, moved) for lag in LAGS.tolist()), key=lambda f: f[0]
    )
    here = motion.piece(rows)
    wanted, turned = here.of(late) @ gains, here.of(motion.turned)
    size = float((wanted**2).sum())
    if not size > 0.0:
        return False
    followed = float((wanted * turned).sum()) / size
    error = float(np.sqrt(((turned - followed * wanted) ** 2).mean() / size))
    if followed + CLEAR * error > FOLLOWS:
        return False
    usual = min(_share(p.of(late) @ gains, m, width)[0] for p, m in zip(flown, moved, strict=True))
    share, error = _share(wanted, turned, width)
    return share + CLEAR * error < usual


def _fitted(
    asked: FloatArray, flown: Sequence[Piece], moved: Sequence[FloatArray]
) -> tuple[float, FloatArray, FloatArray]:
    """(what is left of the squared motion `moved` in these pieces, gains (n, 3) with which it
    follows what is `asked` (N, n), this)."""
    wanted, turned = np.vstack([p.of(asked) for p in flown]), np.vstack(moved)
    gains = np.asarray(np.linalg.lstsq(wanted, turned, rcond=None)[0], dtype=np.float64)
    return float(((turned - wanted @ gains) ** 2).sum()), gains, asked


def _share(wanted: FloatArray, turned: FloatArray, width: int) -> tuple[float, float]:
    """(mean square of the motion (M, 3) without the noise of its sensor, as a share of what is
    `wanted` (M, 3), its standard error), of means over `width` rows; infinite where nothing is."""
    whole = len(wanted) // width * width
    wanted, moved = (v[:whole].reshape(-1, width, 3).mean(axis=1) for v in (wanted, turned))
    size = float((wanted**2).sum(axis=1).mean())
    if size <= 0.0:
        return float("inf"), float("inf")
    alike = float((moved[1:] * moved[:-1]).sum(axis=1).mean())
    error = float(np.sqrt(((moved**2).mean(axis=0) ** 2).sum() / (len(moved) - 1)))
    return alike / size, error / size
