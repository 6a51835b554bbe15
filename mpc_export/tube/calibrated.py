"""How much wider the tube must be than the model says: scales that follow what is measured
(mpc_export/calibration.py).

A plane of normal n is tightened by sqrt(sum_i n_i^2 s_i^2) times as much, s the scales of the
measured place's axes: exact where the axes are equally unsure. The tilt takes the larger scale of
roll and pitch. Between horizons scales are interpolated, beyond the longest they stay. What no
sensor measures keeps what the model says: scale 1. Less than that no plane is tightened: calm air
promises nothing, and the longest horizons need seconds to learn of a gust.

Scales are of errors of measurements, sensor noise included, and widen the covariance of the state
alone: one sample ahead, where most of the error is the sensor's, they tell little of the state;
from .1 s on the state's share prevails.

Scales beyond `MOST` are no answer to an error: where commands come later than the model knows, the
loop swings, limits that run ahead of the plan make it swing more, and the errors grow with them.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from greybox.symbolic import FloatArray
from mpc_export.calibration import COLUMNS, GAIN, LEVEL, normal_half_width
from mpc_export.functions import ModelFunctions
from mpc_export.tube.native import native

MOST = 3.0
"""Scale up to which limits follow. A craft whose commands come 10 ms late (drawn craft 35 of
`scenarios.studies.shocks`) is lost without an end, crosses its limits with 6 and keeps them with 3;
in gusts and with a drained battery errors are about twice what is stated."""


class Calibrated:
    """Forecasts under way and scales of one flight. functions: the model at the filter's sample
    time, group "calibrate".

    `scale` (n_e, n_h) is in force now. `held` and `stated` (n_e, n_h): whether the errors of the
    last sample were within the calibrated intervals and within those of the model alone; NaN where
    no forecast came due.
    """

    def __init__(self, functions: ModelFunctions) -> None:
        self.own = functions.calibration
        self._forecast, self._calibrate = (
            native(functions[n]) for n in ("forecast_step", "calibrate_step")
        )
        self._states = len(functions.states)
        self._half = float(ca.DM(normal_half_width(ca.DM(LEVEL)))) * self.own.sigma
        self._late = [at + delay for at, delay in zip(self.own.first, self.own.delays, strict=True)]
        self._ahead = np.array(self.own.samples) * functions.dt
        names = functions.innovations.names
        self._place, self._tilt = (
            [names.index(n) for n in wanted if n in names]
            for wanted in (
                ("position.x", "position.y", "position.z"),
                ("attitude.x", "attitude.y"),
            )
        )
        self.start()

    def start(self) -> None:
        """As the model says."""
        self._theta = self.own.start()["theta"]
        self.scale = np.ones(self.own.sigma.shape)
        self.held = self.stated = np.full(self.own.sigma.shape, np.nan)
        self.anew()

    def anew(self) -> None:
        """No forecast is under way: what was begun before has nothing to do with the estimate of
        now."""
        self._under_way, self._clock = np.zeros((self._states, COLUMNS)), np.zeros(1)

    def sees(
        self,
        x: FloatArray,
        after: FloatArray,
        u: FloatArray,
        p: FloatArray,
        y: FloatArray,
        there: FloatArray,
    ) -> None:
        """One sample: the filter's state before and after it, the command in force, what is
        measured and believed."""
        self._under_way, self._clock, error, seen = self._forecast(
            x, after, u, p, y, there, self._under_way, self._clock
        )
        size, due = np.abs(error), seen != 0
        self.stated = np.where(due, size <= self._half, np.nan)
        self.held = np.where(due, size <= self._half * np.exp(self._theta[:, self._late]), np.nan)
        self._theta, self.scale = self._calibrate(
            self._theta, error, seen, self.own.sigma, LEVEL, GAIN
        )

    def wider(self, ahead: FloatArray, planes: FloatArray) -> FloatArray:
        """(n, n_p + 1): factors of the planes (n, n_p, 4) and of the tilt, (n,) seconds after the
        last measurement."""
        log = np.log(np.clip(self.scale, 1.0, MOST))
        s = np.exp([np.interp(ahead, self._ahead, row) for row in log]).T
        out = np.ones((len(ahead), planes.shape[1] + 1))
        if len(self._place) == 3:
            normal = planes[..., :3]
            length = np.einsum("kji,kji->kj", normal, normal)
            found = np.einsum("kji,ki->kj", normal**2, s[:, self._place] ** 2) / np.maximum(
                length, 1e-12
            )
            out[:, :-1] = np.where(length > 0, np.sqrt(found), 1.0)
        if self._tilt:
            out[:, -1] = s[:, self._tilt].max(axis=1)
        return out
