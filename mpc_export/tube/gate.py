"""Gate: how far the filter may believe the measurements of a sample.

The size of a sensor's innovation e of covariance S is s = sqrt(e' S^-1 e) / (REACH 2^w) (w = 0: the
normalised innovation squared of Bar-Shalom, Li and Kirubarajan 2001, section 5.4). Up to 1 it
counts in full, up to PARTLY as much as one of size 1 would, beyond not at all (a redescending
influence: Hampel 1974, J. American Statistical Association 69(346)). What persists is not a spike
but the vehicle - a rotor breaks, a mocap frame is corrected - so w grows by one with every sample
that does not count in full. It goes back at once where the next is as before (a spike), else by
RELAX a sample, no lower than what was believed last asks for, so that the filter of an upset
vehicle is not starved. After a gap the next value may be GAP doublings farther off for every sample
without one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from greybox.symbolic import FloatArray

REACH = 8.0
"""Standard deviations. In flights in gusts the largest of all innovations is 5; a rotor that fails
shows as 10 to 40."""
PARTLY = 6.0
"""Size beyond which a value is wrong, whatever the vehicle does."""
WIDEST = 40.0
"""Doublings after which everything finite is believed."""
RELAX, GAP, LONG = 0.02, 0.5, 12
"""Doublings taken back by a sample that is believed; added by one that is missing, so many of them
at most."""
FAR = 1e100
"""Innovations are squared; none counts for more than this."""
UNIT = (0.7, 1.4)
"""A measured quaternion's length must lie between these."""


class Gate:
    """Weights of innovations, sample by sample. columns: those of every innovation, (n_e,) tuples;
    covariance S (n_e, n_e).

    `sensors`: (name, rows of the innovation) of the sensors, those whose columns are measured
    together.
    """

    def __init__(self, columns: Sequence[Sequence[str]], covariance: FloatArray) -> None:
        rows: dict[tuple[str, ...], list[int]] = {}
        for i, names in enumerate(columns):
            rows.setdefault(tuple(names), []).append(i)
        self.sensors = [(", ".join(names), np.array(at)) for names, at in rows.items()]
        self.inverse = np.zeros_like(covariance)
        self._member = np.zeros((len(self.sensors), len(columns)))
        for k, (_, at) in enumerate(self.sensors):
            self.inverse[np.ix_(at, at)] = np.linalg.inv(covariance[np.ix_(at, at)])
            self._member[k, at] = 1.0
        self.start()

    def start(self) -> None:
        """All sensors are believed as they were at first."""
        self.wide = np.zeros(len(self.sensors))
        self.calm = np.zeros(len(self.sensors))
        self.missed = np.zeros(len(self.sensors))

    def __call__(self, innovation: FloatArray, there: FloatArray) -> FloatArray:
        """Share in [0, 1] of every sensor's innovation (n_e,) that is believed; 1 where nothing is
        `there` (n_e,)."""
        share = np.ones(len(self.sensors))
        sizes = self._sizes(innovation)
        if there.all() and not self.missed.any() and not self.wide.any() and sizes.max() <= 1.0:
            return share
        for k, (_, at) in enumerate(self.sensors):
            if not there[at].all():
                self.missed[k] = min(self.missed[k] + 1.0, LONG)
                continue
            size, room = float(sizes[k]), 2.0 ** (self.wide[k] + GAP * self.missed[k])
            self.missed[k] = 0.0
            if size <= room:
                if size <= 2.0 ** self.calm[k]:
                    self.wide[k] = self.calm[k]
                self.calm[k] = self.wide[k] = max(self.wide[k] - RELAX, math.log2(max(size, 1.0)))
            else:
                share[k] = room / size if size <= PARTLY * room else 0.0
                self.wide[k] = min(self.wide[k] + 1.0, WIDEST)
        return share

    def surprise(self, innovation: FloatArray, there: FloatArray) -> float:
        """Minus the log-likelihood of an innovation (n_e,) but for a constant, of the sensors that
        are `there` (n_e,).

        Of Student's t distribution with one degree of freedom and spread REACH S; what is beyond
        PARTLY says no more than that it is wrong.
        """
        sizes = np.minimum(self._sizes(innovation), PARTLY)
        known = np.array([there[at].all() for _, at in self.sensors])
        return float(known @ (0.5 * (1.0 + self._member.sum(axis=1)) * np.log1p(sizes**2)))

    def _sizes(self, innovation: FloatArray) -> FloatArray:
        # what overflows when squared is too far off as well
        e = np.nan_to_num(np.clip(innovation, -FAR, FAR), nan=FAR)
        return np.asarray(np.sqrt(np.maximum(self._member @ (e * (self.inverse @ e)), 0.0)) / REACH)


def plausible(columns: Sequence[str], y: FloatArray) -> FloatArray:
    """Measurements (n_y,) with NaN in place of what no sensor of its kind can say: infinity, a
    quaternion of no length."""
    out = np.where(np.isfinite(y), y, np.nan)
    at = [i for i, c in enumerate(columns) if c in ("qw", "qx", "qy", "qz")]
    if len(at) == 4 and not UNIT[0] <= np.hypot.reduce(np.nan_to_num(out[at])) <= UNIT[1]:
        out[at] = np.nan
    return out
