"""Hover: stay at one point, turning if asked to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from greybox.excitation.signal import Array
from greybox.excitation.trajectory import Trajectory, from_positions, spin


@dataclass(frozen=True, kw_only=True)
class Hover:
    """Position `center` [m], yaw [rad] turning at yaw_rate [rad/s]."""

    center: tuple[float, float, float] = (0.0, 0.0, 1.0)
    yaw: float = 0.0
    yaw_rate: float = 0.0

    def sample(self, time: Array, rng: np.random.Generator) -> Trajectory:
        """The reference at uniform times (N,) [s]."""
        return from_positions(
            time,
            np.tile(np.array(self.center), (time.size, 1)),
            spin(time, self.yaw, self.yaw_rate),
        )
