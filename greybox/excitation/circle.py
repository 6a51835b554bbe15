"""A horizontal circle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from greybox.excitation.signal import Array
from greybox.excitation.trajectory import Trajectory, from_positions, phase, spin


@dataclass(frozen=True, kw_only=True)
class Circle:
    """Circle of `radius` [m] about `center`, started from rest at its rightmost point.

    One turn takes `period` s once `ramp` s have passed; the height swings by `climb` [m] once per
    turn; the path is turned by `heading` [rad] in the world; yaw turns at yaw_rate [rad/s].
    """

    radius: float = 1.0
    period: float = 5.0
    ramp: float = 2.0
    climb: float = 0.0
    heading: float = 0.0
    center: tuple[float, float, float] = (0.0, 0.0, 1.0)
    yaw: float = 0.0
    yaw_rate: float = 0.0

    def sample(self, time: Array, rng: np.random.Generator) -> Trajectory:
        """The reference at uniform times (N,) [s]."""
        angle = phase(time, self.period, self.ramp)
        x = self.radius * np.cos(angle)
        y = self.radius * np.sin(angle)
        cosine, sine = np.cos(self.heading), np.sin(self.heading)
        path = np.column_stack(
            [cosine * x - sine * y, sine * x + cosine * y, self.climb * np.sin(angle)]
        )
        return from_positions(
            time, path + np.array(self.center), spin(time, self.yaw, self.yaw_rate)
        )
