"""Closed curves in a plane, flown turn by turn: what all of them have."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from greybox.excitation.signal import Array
from greybox.excitation.trajectory import Trajectory, from_positions, phase, spin


@dataclass(frozen=True, kw_only=True)
class PlaneCurve(ABC):
    """A curve of half width `radius` [m] about `center`, started from rest.

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

    @abstractmethod
    def place(self, angle: Array) -> tuple[Array, Array]:
        """x and y (N,) [m] of the curve about the origin at the angles (N,) [rad] of a turn."""

    def sample(self, time: Array, rng: np.random.Generator) -> Trajectory:
        """The reference at uniform times (N,) [s]."""
        angle = phase(time, self.period, self.ramp)
        x, y = self.place(angle)
        cosine, sine = np.cos(self.heading), np.sin(self.heading)
        path = np.column_stack(
            [cosine * x - sine * y, sine * x + cosine * y, self.climb * np.sin(angle)]
        )
        return from_positions(
            time, path + np.array(self.center), spin(time, self.yaw, self.yaw_rate)
        )
