"""What a course is: legs between points, planes that must not be crossed, limits of attitude and
commands."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from greybox.symbolic import BoolArray, FloatArray


@dataclass(frozen=True, kw_only=True, eq=False)
class SampledPath:
    """Sampled reference: position, velocity, acceleration, each (n, 3), world [m, m/s, m/s^2]; yaw,
    yaw_rate (n,)."""

    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    yaw: FloatArray
    yaw_rate: FloatArray


@dataclass(frozen=True, kw_only=True)
class Plane:
    """A limit on the centre of mass, normal . position <= offset [m], the vehicle's own size
    already taken off.

    normal: unit vector, world. where: axis (0, 1, 2) -> (low, high) [m], the stretch along which
    the plane exists; a wall without ends has none.
    """

    name: str
    normal: tuple[float, float, float]
    offset: float
    where: Mapping[int, tuple[float, float]]

    def margin(self, position: FloatArray) -> FloatArray:
        """Distance to the plane [m] of positions (..., 3): negative beyond it, infinite where it
        does not exist."""
        return np.where(
            self.exists(position), self.offset - position @ np.array(self.normal), np.inf
        )

    def exists(self, position: FloatArray, reach: float = 0.0) -> BoolArray:
        """Whether the plane exists at positions (..., 3), its stretch lengthened by `reach` [m] at
        both ends."""
        inside = np.ones(position.shape[:-1], dtype=bool)
        for axis, (low, high) in self.where.items():
            inside &= (position[..., axis] >= low - reach) & (position[..., axis] <= high + reach)
        return inside


@dataclass(frozen=True, kw_only=True)
class Leg:
    """A minimum-jerk movement to `to` (x, y, z [m], yaw [rad]) within `time` s, then rest for
    `hold` s."""

    to: tuple[float, float, float, float]
    time: float
    hold: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Course:
    """Legs from `start` (x, y, z [m], yaw [rad]) after `wait` s of hover, and the limits along
    them.

    tilt_max [rad] is the largest allowed angle between thrust and vertical; command_min and
    command_max bound the commands. lost [m]: a flight farther than this from its reference counts
    as crashed.
    """

    start: tuple[float, float, float, float]
    wait: float
    legs: tuple[Leg, ...]
    planes: tuple[Plane, ...]
    tilt_max: float
    command_min: float
    command_max: float
    lost: float

    @cached_property
    def duration(self) -> float:
        """Length of the flight [s]."""
        return self.wait + sum(leg.time + leg.hold for leg in self.legs)

    def sample(self, time: FloatArray, rng: np.random.Generator | None = None) -> SampledPath:
        """The reference at any times (N,) [s], at rest before the start and after the end;
        derivatives are exact.

        rng is not used: every flight has the same reference.
        """
        path = np.tile(np.array(self.start, dtype=float), (time.size, 1))
        speed, push = np.zeros_like(path), np.zeros_like(path)
        here, begin = np.array(self.start, dtype=float), self.wait
        for leg in self.legs:
            there = np.array(leg.to, dtype=float)
            s = np.clip((time - begin) / leg.time, 0.0, 1.0)
            step = there - here
            path += np.outer(s**3 * (10.0 - 15.0 * s + 6.0 * s**2), step)
            speed += np.outer(30.0 * s**2 * (1.0 - s) ** 2 / leg.time, step)
            push += np.outer(60.0 * s * (1.0 - s) * (1.0 - 2.0 * s) / leg.time**2, step)
            here, begin = there, begin + leg.time + leg.hold
        return SampledPath(
            position=path[:, :3],
            velocity=speed[:, :3],
            acceleration=push[:, :3],
            yaw=path[:, 3],
            yaw_rate=speed[:, 3],
        )

    def margins(self, position: FloatArray) -> dict[str, FloatArray]:
        """Distance to every plane [m] by its name, for positions (..., 3)."""
        return {plane.name: plane.margin(position) for plane in self.planes}
