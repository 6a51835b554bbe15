"""Random waypoints joined by smooth legs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from greybox.excitation.signal import Array
from greybox.excitation.trajectory import Trajectory, from_positions, spin


@dataclass(frozen=True, kw_only=True)
class RandomWaypoints:
    """Points drawn uniformly from a box of half widths `box` [m] about `center`, joined by
    minimum-jerk legs.

    A leg takes between `shortest` and `longest` s and never asks for more than `speed` [m/s] at its
    middle; every leg starts and ends at rest. yaw_swing [rad] is the half width of random yaw
    targets, reached along with the points.
    """

    box: tuple[float, float, float] = (1.5, 1.5, 0.4)
    center: tuple[float, float, float] = (0.0, 0.0, 1.0)
    shortest: float = 1.0
    longest: float = 2.5
    speed: float = 2.5
    yaw: float = 0.0
    yaw_rate: float = 0.0
    yaw_swing: float = 0.0

    def sample(self, time: Array, rng: np.random.Generator) -> Trajectory:
        """The reference at uniform times (N,) [s]."""
        middle, box = np.array([*self.center, 0.0]), np.array([*self.box, self.yaw_swing])
        path = np.empty((time.size, 4))
        here, begin = middle, float(time[0])
        while begin <= time[-1]:
            there = middle + box * rng.uniform(-1.0, 1.0, 4)
            # the middle of a minimum-jerk leg is 15/8 times as fast as its mean
            length = max(
                rng.uniform(self.shortest, self.longest),
                1.875 * float(np.linalg.norm((there - here)[:3])) / self.speed,
            )
            mask = time >= begin
            s = np.clip((time[mask] - begin) / length, 0.0, 1.0)
            path[mask] = here + np.outer(s**3 * (10.0 - 15.0 * s + 6.0 * s**2), there - here)
            here, begin = there, begin + length
        return from_positions(time, path[:, :3], spin(time, self.yaw, self.yaw_rate) + path[:, 3])
