"""A cascade flight controller: position, attitude, body rates, mixer; it sees what a real one sees.

Batch or single: all quantities are components, floats or arrays of shape (B,).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from greybox.plants.airframe import Airframe
from greybox.plants.vectors import (
    ZERO,
    Matrix,
    Number,
    Vector,
    add,
    apply_transposed,
    clip,
    cross,
    norm,
    rotation,
    subtract,
)

Mixer = tuple[Number, Number, Number, Number]
"""Added at the mixer's inputs: specific thrust [m/s^2], angular accelerations about x, y, z
[rad/s^2]."""


@dataclass(frozen=True, kw_only=True)
class Gains:
    """Loop gains, horizontal and vertical position [1/s^2, 1/s, 1/s^3], attitude [1/s], rates [1/s,
    1/s^2], and limits.

    position, velocity, position_integral act on the position error, velocity error and integral of
    the position error; attitude turns the attitude error into a rate setpoint; rate and
    rate_integral turn the rate error into angular acceleration. yaw and yaw_rate replace attitude
    and rate about z. tilt_max [rad], rate_max [rad/s].
    """

    position: float = 4.0
    velocity: float = 3.5
    position_integral: float = 0.8
    height: float = 7.0
    climb: float = 5.0
    height_integral: float = 2.0
    attitude: float = 7.0
    yaw: float = 3.0
    rate: float = 18.0
    yaw_rate: float = 8.0
    rate_integral: float = 12.0
    tilt_max: float = 0.7
    rate_max: float = 6.0


@dataclass(frozen=True, kw_only=True)
class Setpoint:
    """What to do now: position [m], velocity [m/s], acceleration [m/s^2], world; yaw [rad],
    yaw_rate [rad/s]."""

    position: Vector
    velocity: Vector = ZERO
    acceleration: Vector = ZERO
    yaw: Number = 0.0
    yaw_rate: Number = 0.0


class CascadeController:
    """Position to tilt and thrust, attitude to rates, rates to moments, moments to rotor commands.

    airframe: what the controller believes the vehicle to be (the plant's may differ). feedback:
    "measured" uses the noisy measurements, "truth" the true state. Integrators carry what the
    belief gets wrong.
    """

    def __init__(
        self, airframe: Airframe, gains: Gains | None = None, *, feedback: str = "measured"
    ) -> None:
        if feedback not in ("measured", "truth"):
            raise ValueError(f'feedback is "measured" or "truth", got {feedback!r}')
        self.airframe = airframe
        self.gains = gains or Gains()
        self.feedback = feedback
        arms = [subtract(rotor.position, airframe.center_of_mass) for rotor in airframe.rotors]
        hover = float(np.mean(airframe.hover_speed))
        t0, t1, t2 = (float(np.mean(c)) for c in airframe.thrust)
        q0, q1, q2 = (float(np.mean(c)) for c in airframe.torque)
        ratio = (q0 + hover * (q1 + hover * q2)) / (t0 + hover * (t1 + hover * t2))
        wrench = [
            [1.0 for _ in arms],
            [float(np.mean(a[1])) for a in arms],
            [-float(np.mean(a[0])) for a in arms],
            [-rotor.spin * ratio for rotor in airframe.rotors],
        ]
        self._mixer: list[list[float]] = np.linalg.pinv(np.array(wrench)).tolist()
        """Rotor thrusts from total thrust and the three moments, one row per rotor."""
        self._thrust_max = 0.95 * len(arms) * (t0 + airframe.u_max * (t1 + airframe.u_max * t2))
        self.reset()

    def reset(self) -> None:
        """Forget the integrators."""
        self._place: Vector = ZERO
        self._turn: Vector = ZERO

    def __call__(
        self,
        seen: dict[str, Number],
        goal: Setpoint,
        dt: float,
        inject: Mixer,
    ) -> list[Number]:
        """Rotor commands in [u_min, u_max] from measurements by column name.

        inject: excitation added at the mixer's inputs.
        """
        frame = self.airframe
        turn = rotation((seen["qw"], seen["qx"], seen["qy"], seen["qz"]))
        wanted = self._acceleration(seen, goal, dt)
        specific, desired = self._attitude(turn, wanted, goal.yaw)
        angular = self._angular(seen, turn, desired, goal.yaw_rate, dt)
        thrust = clip(frame.mass * (specific + inject[0]), 0.0, self._thrust_max)
        moments = [j * (a + e) for j, a, e in zip(frame.inertia, angular, inject[1:])]
        wrench = (thrust, *moments)
        commands = []
        for row in self._mixer:
            force = sum(m * w for m, w in zip(row, wrench))
            commands.append(clip(frame.command_for_thrust(force), frame.u_min, frame.u_max))
        return commands

    def _acceleration(self, seen: dict[str, Number], goal: Setpoint, dt: float) -> Vector:
        """Wanted acceleration plus gravity, world [m/s^2]."""
        g = self.gains
        away = subtract(goal.position, (seen["x"], seen["y"], seen["z"]))
        slip = subtract(goal.velocity, (seen["vx"], seen["vy"], seen["vz"]))
        self._place = tuple(clip(s + dt * e, -1.0, 1.0) for s, e in zip(self._place, away))
        gains = (
            (g.position, g.velocity, g.position_integral),
            (g.position, g.velocity, g.position_integral),
            (g.height, g.climb, g.height_integral),
        )
        ax, ay, az = (
            a + kp * clip(e, -1.5, 1.5) + kv * s + ki * i
            for a, e, s, i, (kp, kv, ki) in zip(goal.acceleration, away, slip, self._place, gains)
        )
        up = clip(
            az + self.airframe.gravity, 0.3 * self.airframe.gravity, 2.0 * self.airframe.gravity
        )
        side = (ax * ax + ay * ay) ** 0.5
        limit = up * math.tan(g.tilt_max)
        shrink = clip(limit / (side + 1e-9), 0.0, 1.0)
        return (ax * shrink, ay * shrink, up)

    @staticmethod
    def _attitude(turn: Matrix, wanted: Vector, yaw: Number) -> tuple[Number, Vector]:
        """Specific thrust along the present body z, and the attitude error that remains (body axes,
        about [rad])."""
        specific = wanted[0] * turn[2] + wanted[1] * turn[5] + wanted[2] * turn[8]
        size = norm(wanted)
        zx, zy, zz = wanted[0] / size, wanted[1] / size, wanted[2] / size
        cosine, sine = (
            (math.cos(yaw), math.sin(yaw)) if isinstance(yaw, float) else (np.cos(yaw), np.sin(yaw))
        )
        y_axis = cross((zx, zy, zz), (cosine, sine, 0.0))
        length = norm(y_axis)
        y_axis = (y_axis[0] / length, y_axis[1] / length, y_axis[2] / length)
        x_axis = cross(y_axis, (zx, zy, zz))
        # sum of the cross products of present and wanted axes, in world, is twice the sine of the
        # error
        now = (
            (turn[0], turn[3], turn[6]),
            (turn[1], turn[4], turn[7]),
            (turn[2], turn[5], turn[8]),
        )
        error = ZERO
        for have, want in zip(now, (x_axis, y_axis, (zx, zy, zz))):
            error = add(error, cross(have, want))
        ex, ey, ez = apply_transposed(turn, error)
        return specific, (0.5 * ex, 0.5 * ey, 0.5 * ez)

    def _angular(
        self, seen: dict[str, Number], turn: Matrix, error: Vector, yaw_rate: Number, dt: float
    ) -> Vector:
        """Wanted angular acceleration, body [rad/s^2]."""
        g = self.gains
        goal = (g.attitude * error[0], g.attitude * error[1], g.yaw * error[2] + yaw_rate)
        slip = tuple(clip(w, -g.rate_max, g.rate_max) - seen[name] for w, name in zip(goal, "pqr"))
        self._turn = tuple(clip(s + dt * e, -3.0, 3.0) for s, e in zip(self._turn, slip))
        px, py, pz = (
            k * e + g.rate_integral * s
            for k, e, s in zip((g.rate, g.rate, g.yaw_rate), slip, self._turn)
        )
        return (px, py, clip(pz, -25.0, 25.0))
