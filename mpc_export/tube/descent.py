"""The declared descent: when the controller gives up the path, and the reference that it flies
then.

It is declared, once and for the rest of the flight, where more often than not, for the times
stated,

    no steady command within the limits holds the place, for HELD s (a rotor or the battery has lost
    too much), position or attitude is not measured, or not believed, for as long as the filter may
    carry on without (`longest_without_pose`; the first SLOW s of every gap do not count), or the
    estimate is farther from the path than the controller's `lost` for AWAY s.

The reference brakes at BRAKE to a descent of SPEED straight down. Yaw is given up: its reference is
where the plan turns to anyway, so that what thrust is left serves tilt and height. Planes are those
of the moment of the declaration.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from greybox.symbolic import FloatArray
from mpc_export.functions import ModelFunctions

HELD, AWAY = 0.5, 0.1
"""For how long a reason must hold [s]."""
UNSURE, BLIND = 0.05, 1.0
"""Standard deviation of a coordinate up to which the filter carries on without a pose [m], and for
how long at most [s]: it is stated for flights like those that the model was fitted to."""
POSE = frozenset({"x", "y", "z", "vx", "vy", "vz", "qw", "qx", "qy", "qz"})
"""Columns that one system of cameras or satellites gives, and fails to give together."""
SLOW = 0.15
"""Age of the last pose [s] up to which it is merely slow: one at 5 Hz flies on, one at 2 Hz does
not."""
SPEED, BRAKE = 0.5, 3.0
"""Speed of the descent [m/s] and acceleration of the way into it [m/s^2]."""


@dataclass(frozen=True, kw_only=True)
class Way:
    """Samples of a reference at n times: position, velocity, acceleration (n, 3), world [m, s]; yaw
    (n,) [rad]."""

    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    yaw: FloatArray


@dataclass(frozen=True, kw_only=True)
class Descent:
    """Straight down from where the vehicle was at `time` [s], at `position` and `velocity` (3,),
    heading `yaw`."""

    time: float
    position: FloatArray
    velocity: FloatArray
    yaw: float

    def sample(self, time: FloatArray) -> Way:
        """The reference at the times (n,)."""
        final = np.array([0.0, 0.0, -SPEED])
        change = self.velocity - final
        length = max(float(np.linalg.norm(change)) / BRAKE, 1e-6)
        t = np.maximum(np.asarray(time, dtype=float) - self.time, 0.0)[:, None]
        s = np.minimum(t, length)
        return Way(
            position=self.position + final * t + change * (s - s**2 / (2.0 * length)),
            velocity=final + change * (1.0 - s / length),
            acceleration=np.where(t < length, -change / length, 0.0),
            yaw=np.full(len(t), self.yaw),
        )


def longest_without_pose(functions: ModelFunctions, columns: Sequence[Sequence[str]]) -> float:
    """For how long the filter carries on without a pose [s]: until its covariance, propagated about
    hover and corrected by what is still measured (Kalman 1960), says of a coordinate UNSURE more
    than with one (whose position may itself be no better, from satellites); SLOW at least, BLIND at
    most.

    columns: those of every innovation, (n_e,) tuples."""
    x, u = functions.reference
    p, names = functions.parameter_values, functions.error_states.names
    a = functions["f_d_jac"](x, u, p)[1].full()
    left = [i for i, own in enumerate(columns) if not POSE & set(own)]
    c, noise = (
        functions["h_jac"](x, u, p)[1].full()[left],
        np.diag(functions.noise.sensor[left] ** 2),
    )
    covariance, place = (
        functions.noise.covariance,
        [i for i, n in enumerate(names) if "position" in n],
    )
    steps, known = round(BLIND / functions.dt), np.diag(covariance)[place]
    for k in range(steps):
        gain = np.linalg.solve(c @ covariance @ c.T + noise, c @ covariance).T
        covariance = a @ (covariance - gain @ c @ covariance) @ a.T + functions.noise.filtered
        if not (np.diag(covariance)[place] - known).max(initial=0.0) <= UNSURE**2:
            return max(k * functions.dt, SLOW)
    return steps * functions.dt


class Watch:
    """For how long each reason to come down has held, less the time for which it has not since."""

    def __init__(self) -> None:
        self.held: dict[str, float] = {}

    def __call__(self, passed: float, reasons: dict[str, tuple[bool, float]]) -> str | None:
        """The reason, if any, that has held for long enough; whether each holds in the `passed` s,
        and how long it must."""
        for text, (holds, long) in reasons.items():
            self.held[text] = max(self.held.get(text, 0.0) + (passed if holds else -passed), 0.0)
            if holds and self.held[text] >= long - 1e-9:
                return text
        return None
