"""A cascade of PID loops that knows only what a vehicle file says: the rival that every craft has
on board.

Position errors ask for an acceleration, that for a tilt and a thrust, the attitude error for rates,
rates for moments, and a mixer turns thrust and moments into rotor commands. Integrators carry what
the vehicle file gets wrong.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from greybox.frames import numeric
from greybox.model.vehicle import Vehicle
from greybox.symbolic import FloatArray
from mpc_export.mission.course import SampledPath


@dataclass(frozen=True, kw_only=True)
class Gains:
    """Loop gains of position [1/s^2], velocity [1/s], integral of position [1/s^3], attitude [1/s],
    rates [1/s] and their integral [1/s^2], each (3,) world or body axes; `tilt_max` [rad],
    `rate_max` [rad/s]."""

    position: tuple[float, float, float] = (4.0, 4.0, 7.0)
    velocity: tuple[float, float, float] = (3.5, 3.5, 5.0)
    integral: tuple[float, float, float] = (0.8, 0.8, 2.0)
    attitude: tuple[float, float, float] = (7.0, 7.0, 3.0)
    rate: tuple[float, float, float] = (18.0, 18.0, 8.0)
    rate_integral: float = 12.0
    tilt_max: float = 0.7
    rate_max: float = 6.0


class CascadeController:
    """Rotor commands from measurements by column name and a sampled path (its first row)."""

    def __init__(self, vehicle: Vehicle, gains: Gains | None = None) -> None:
        self.vehicle, self.gains = vehicle, gains or Gains()
        self.thrust = np.array([q.value for q in vehicle.actuator.thrust])
        torque = np.array([q.value for q in vehicle.actuator.torque])
        self.hover = float(
            self._command(np.array([vehicle.mass.value * vehicle.gravity / vehicle.n_rotors]))[0]
        )
        powers = self.hover ** np.arange(3.0)
        ratio = float(torque @ powers) / float(self.thrust @ powers)
        center = np.array([q.value for q in vehicle.center_of_mass])
        arms = np.array([r.position for r in vehicle.rotors]) - center
        spins = np.array([r.spin for r in vehicle.rotors])
        wrench = np.vstack([np.ones(len(arms)), arms[:, 1], -arms[:, 0], -spins * ratio])
        self.mixer = np.linalg.pinv(wrench)
        full = float(self.thrust @ vehicle.actuator.u_max ** np.arange(3.0))
        self.thrust_max = 0.95 * len(arms) * full
        self.reset()

    def reset(self) -> None:
        """Forget the integrators."""
        self.place, self.turn = np.zeros(3), np.zeros(3)

    def __call__(self, seen: Mapping[str, float], goal: SampledPath, dt: float) -> FloatArray:
        """Commands (n,) in [u_min, u_max] for the next `dt` seconds."""
        specific, rates = self.asked(seen, goal, dt)
        angular = self._angular(seen, rates, dt)
        thrust = np.clip(self.vehicle.mass.value * specific, 0.0, self.thrust_max)
        moments = np.diag(np.array(self.vehicle.inertia)) * angular
        forces = self.mixer @ np.concatenate([[thrust], moments])
        actuator = self.vehicle.actuator
        return np.clip(self._command(forces), actuator.u_min, actuator.u_max)

    def asked(
        self, seen: Mapping[str, float], goal: SampledPath, dt: float
    ) -> tuple[float, FloatArray]:
        """What the outer loops ask of a rate controller: specific thrust [m/s^2] and body rates
        (3,) [rad/s], each within `rate_max`."""
        quaternion = np.array([[seen[n] for n in ("qw", "qx", "qy", "qz")]])
        # Columns: the body's axes in the world.
        now = np.column_stack([numeric("rotate", quaternion, axis[None])[0] for axis in np.eye(3)])
        wanted = self._acceleration(seen, goal, dt)
        specific, error = _attitude(now, wanted, float(goal.yaw[0]))
        rates = np.array(self.gains.attitude) * error + np.array(
            [0.0, 0.0, float(goal.yaw_rate[0])]
        )
        return specific, np.clip(rates, -self.gains.rate_max, self.gains.rate_max)

    def collective(self, specific: float) -> float:
        """The command that every rotor needs for a specific thrust [m/s^2], within what the
        actuators can."""
        thrust = float(np.clip(self.vehicle.mass.value * specific, 0.0, self.thrust_max))
        return float(self._command(np.array([thrust / self.vehicle.n_rotors]))[0])

    def _command(self, thrust: FloatArray) -> FloatArray:
        """The thrust map inverted on its rising branch."""
        c0, c1, c2 = self.thrust
        if c2 == 0.0:
            return np.asarray((thrust - c0) / c1)
        inside = np.maximum(c1 * c1 + 4.0 * c2 * (thrust - c0), 0.0)
        return np.asarray((np.sqrt(inside) - c1) / (2.0 * c2))

    def _acceleration(self, seen: Mapping[str, float], goal: SampledPath, dt: float) -> FloatArray:
        """Wanted acceleration plus gravity, world [m/s^2]."""
        g, gravity = self.gains, self.vehicle.gravity
        away = goal.position[0] - np.array([seen[n] for n in ("x", "y", "z")])
        slip = goal.velocity[0] - np.array([seen[n] for n in ("vx", "vy", "vz")])
        self.place = np.clip(self.place + dt * away, -1.0, 1.0)
        wanted = (
            goal.acceleration[0]
            + np.array(g.position) * np.clip(away, -1.5, 1.5)
            + np.array(g.velocity) * slip
            + np.array(g.integral) * self.place
        )
        up = float(np.clip(wanted[2] + gravity, 0.3 * gravity, 2.0 * gravity))
        side = float(np.hypot(wanted[0], wanted[1]))
        shrink = float(np.clip(up * np.tan(g.tilt_max) / (side + 1e-9), 0.0, 1.0))
        return np.array([wanted[0] * shrink, wanted[1] * shrink, up])

    def _angular(self, seen: Mapping[str, float], rates: FloatArray, dt: float) -> FloatArray:
        """Wanted angular acceleration, body [rad/s^2]."""
        g = self.gains
        slip = rates - np.array([seen[n] for n in ("p", "q", "r")])
        self.turn = np.clip(self.turn + dt * slip, -3.0, 3.0)
        out = np.array(g.rate) * slip + g.rate_integral * self.turn
        return np.array([out[0], out[1], float(np.clip(out[2], -25.0, 25.0))])


def _attitude(now: FloatArray, wanted: FloatArray, yaw: float) -> tuple[float, FloatArray]:
    """Specific thrust along the present body z, and the attitude error that remains (body axes,
    about [rad])."""
    z = wanted / np.linalg.norm(wanted)
    y = np.cross(z, [np.cos(yaw), np.sin(yaw), 0.0])
    y /= np.linalg.norm(y)
    desired = np.column_stack([np.cross(y, z), y, z])
    # The sum of the cross products of present and wanted axes is twice the sine of the error.
    error = 0.5 * np.cross(now.T, desired.T).sum(axis=0)
    return float(wanted @ now[:, 2]), np.asarray(now.T @ error)
