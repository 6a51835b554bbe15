"""Flow: all signals at one instant, as effects and sensors see them, and what either may
remember."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr


@dataclass(frozen=True, kw_only=True)
class Flow:
    """All signals that an effect may look at, at one instant. Vectors in body axes (FLU) unless the
    name says world.

    Fields that the stage at hand does not know yet are None (a command effect sees no thrust).
    """

    vehicle: Vehicle
    command: Expr = None  # u (n), after earlier members of the chain
    nu: Expr = None  # normalised rotor speed (n)
    nu_rate: Expr = None  # d nu / dt [1/s] (n)
    rotor_speed: Expr = (
        None  # Omega_i = speed_max nu_i [rad/s] (n); per unit nu where speed_max is unknown
    )
    thrust: Expr = None  # baseline thrust T_i [N] (n)
    vbat: Expr = None  # battery voltage [V]
    velocity: Expr = None  # ground velocity of the centre of mass, body axes [m/s]
    velocity_world: Expr = None  # the same in world axes [m/s]
    wind: Expr = None  # wind velocity, body axes [m/s]
    omega: Expr = None  # body rate [rad/s]
    angular_acceleration: Expr = None  # d omega / dt [rad/s^2]
    acceleration_world: Expr = None  # d velocity_world / dt [m/s^2]
    rotation: Expr = None  # R, body to world (3 x 3)
    quaternion: Expr = None  # (w, x, y, z), body to world
    position: Expr = None  # of the centre of mass, world [m]
    center_of_mass: Expr = None  # from the body origin, body axes [m]
    memory: Expr = None  # what this effect or sensor remembers (see its `memory`)
    arms: Expr = None  # r_i, hub positions from the centre of mass (3 x n) [m]
    mass: Expr = None  # [kg]
    measured: Expr = None  # sensor name -> value after earlier members of the chain

    def airspeed(self, i: int) -> Expr:
        """v_a,i = R^T (v - w) + omega x r_i, airspeed of hub i in body axes [m/s]."""
        return self.velocity - self.wind + ca.cross(self.omega, self.arms[:, i])


@dataclass(frozen=True, kw_only=True)
class Remembered:
    """One state of an effect's or a sensor's own, as a temperature, the velocity of a wake or a
    bias that drifts.

    `size` [`unit`] is typical of it: the spread of what it may be, around zero, when a flight
    begins. `drift` [`unit`/sqrt(s)], where it is above zero, lets white noise push the state: by so
    much in the first second, as one standard deviation. That is where a fit begins, which estimates
    the level as it does all noise.
    """

    name: str
    unit: str
    size: float
    meaning: str = ""
    drift: float = 0.0


def unit_per_speed(vehicle: Vehicle, known: str, at_full_speed: str) -> str:
    """Unit of a coefficient that multiplies rotor speeds (`Flow.rotor_speed`): `known` where they
    are in rad/s, `at_full_speed` where speed_max is unknown and they are nu."""
    return at_full_speed if vehicle.actuator.speed_max is None else known
