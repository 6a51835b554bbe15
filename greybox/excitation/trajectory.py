"""What a reference is: positions and yaw over time, with the derivatives that a controller feeds
forward."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from greybox.excitation.signal import Array


@dataclass(frozen=True, kw_only=True)
class Trajectory:
    """Sampled reference: position, velocity, acceleration, each (N, 3), world [m, m/s, m/s^2]; yaw,
    yaw_rate (N,)."""

    position: Array
    velocity: Array
    acceleration: Array
    yaw: Array
    yaw_rate: Array


class Reference(Protocol):
    """A reference design; members are frozen dataclasses."""

    def sample(self, time: Array, rng: np.random.Generator) -> Trajectory:
        """The reference at uniform times (N,) [s]."""
        ...


def from_positions(time: Array, position: Array, yaw: Array) -> Trajectory:
    """A trajectory whose derivatives are central differences of its positions (N, 3) and yaw angles
    (N,)."""
    if time.size < 3:
        zero = np.zeros_like(position)
        return Trajectory(
            position=position,
            velocity=zero,
            acceleration=zero,
            yaw=yaw,
            yaw_rate=np.zeros_like(yaw),
        )
    velocity = np.gradient(position, time, axis=0)
    return Trajectory(
        position=position,
        velocity=velocity,
        acceleration=np.gradient(velocity, time, axis=0),
        yaw=yaw,
        yaw_rate=np.gradient(np.unwrap(yaw), time),
    )


def phase(time: Array, period: float, ramp: float) -> Array:
    """Angle [rad] that starts at rest and reaches one turn per `period` s after `ramp` s."""
    s = np.clip(time / ramp, 0.0, 1.0) if ramp > 0.0 else np.ones_like(time)
    # integral of the smooth step 3 s^2 - 2 s^3
    eased = ramp * (s**3 - 0.5 * s**4) + np.maximum(time - ramp, 0.0)
    return np.asarray(2.0 * np.pi * eased / period)


def spin(time: Array, yaw: float, yaw_rate: float) -> Array:
    """Yaw angle (N,) [rad] that starts at `yaw` and turns at `yaw_rate` [rad/s]."""
    return np.asarray(yaw + yaw_rate * time)
