"""What an effect of a simulated plant may do: one hook per place where physics can act.

An effect is a frozen dataclass whose fields are its parameters, under the names that the flight-log
world uses; it overrides the hooks it needs and leaves the others alone. A hook that is not
overridden costs nothing in flight.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from typing import Any, ClassVar

from greybox.plants.vectors import ZERO, Matrix, Number, Quaternion, Vector


class Body:
    """The vehicle at one instant, as effects see it.

    time [s]; position and velocity of the centre of mass, world [m, m/s]; attitude quaternion and
    its rotation matrix, body to world; rates, body [rad/s]; airspeed of the centre of mass, body
    [m/s]; wind, world [m/s]; nu and nu_rate per rotor [-, 1/s]; speed and speed_rate per rotor
    [rad/s, rad/s^2]; voltage [V]; hidden states by effect name.
    """

    __slots__ = (
        "airspeed",
        "attitude",
        "hidden",
        "nu",
        "nu_rate",
        "position",
        "rates",
        "rotation",
        "speed",
        "speed_rate",
        "time",
        "velocity",
        "voltage",
        "wind",
    )

    time: Number
    position: Vector
    velocity: Vector
    attitude: Quaternion
    rotation: Matrix
    rates: Vector
    airspeed: Vector
    wind: Vector
    nu: list[Number]
    nu_rate: list[Number]
    speed: list[Number]
    speed_rate: list[Number]
    voltage: Number
    hidden: dict[str, list[Number]]


class Hub:
    """One rotor hub at one instant.

    index from 0; spin; arm from the centre of mass [m]; airspeed of the hub, body [m/s]; nu; speed
    [rad/s]; thrust and torque magnitudes of the maps [N, N m]; body: the vehicle.
    """

    __slots__ = ("airspeed", "arm", "body", "index", "nu", "speed", "spin", "thrust", "torque")

    def __init__(
        self,
        index: int,
        spin: int,
        arm: Vector,
        airspeed: Vector,
        nu: Number,
        speed: Number,
        thrust: Number,
        torque: Number,
        body: Body,
    ) -> None:
        self.index = index
        self.spin = spin
        self.arm = arm
        self.airspeed = airspeed
        self.nu = nu
        self.speed = speed
        self.thrust = thrust
        self.torque = torque
        self.body = body


class PlantEffect:
    """Base of all effects; subclasses are frozen dataclasses and set `name`."""

    name: ClassVar[str]
    order: ClassVar[int] = 0
    """Place in a stage's chain where order matters: saturation 1, curve 2; misalignment 1, scale 2,
    bias 3."""
    hidden: ClassVar[int] = 0
    """Number of hidden states that the effect brings."""

    needs_speed_rate: ClassVar[bool] = False
    """Whether the effect reads `Body.nu_rate` or `Body.speed_rate`, which are not filled
    otherwise."""

    def parameters(self) -> dict[str, Number]:
        """Parameter values by canonical name, `effect.parameter`."""
        return {f"{self.name}.{f.name}": getattr(self, f.name) for f in fields(self)}  # type: ignore[arg-type]

    # command and rotor
    def delay(self) -> float:
        """Delay of the command [s]."""
        return 0.0

    def command(self, u: Number) -> Number:
        """Command of one rotor after this effect."""
        return u

    def rotor_factor(self, voltage: Number) -> Number:
        """Factor on the steady rotor speed at this battery voltage [V]."""
        return 1.0

    def lag(self) -> Number:
        """Time constant [s] of the rotor speed."""
        return 0.0

    def lag_asymmetry(self) -> Number:
        """Share of itself by which that is longer going down, and shorter going up."""
        return 0.0

    def lag_drag(self) -> tuple[Number, Number]:
        """(b, k) tau / J of a rotor J dnu/dt = b (target - nu) + k (target^2 - nu^2)."""
        return (1.0, 0.0)

    def lag_second(self) -> Number:
        """b of a rotor b lag^2 nu'' + lag nu' + nu = target."""
        return 0.0

    # thrust
    def thrust_factor(self, hub: Hub) -> Number:
        """Factor on the thrust of one rotor."""
        return 1.0

    def torque_factor(self, hub: Hub) -> Number:
        """Factor on the drag torque of one rotor."""
        return 1.0

    def thrust_increment(self, hub: Hub) -> Number:
        """Thrust added to one rotor [N]."""
        return 0.0

    # body
    def mass_factor(self) -> Number:
        """Factor on the mass."""
        return 1.0

    def inertia_change(self) -> tuple[Vector, Vector]:
        """Increments of the inertia matrix: (xx, yy, zz) and (xy, xz, yz) [kg m^2]."""
        return (ZERO, ZERO)

    def center_of_mass_shift(self) -> Vector:
        """Shift of the centre of mass, body [m]."""
        return ZERO

    # wrench
    def wind(self, body: Body) -> Vector:
        """Wind added, world [m/s]."""
        return ZERO

    def hub_force(self, hub: Hub) -> Vector:
        """Force at one hub, body [N]; its moment about the centre of mass is added by the plant."""
        return ZERO

    def hub_moment(self, hub: Hub) -> Vector:
        """Free moment of one rotor, body [N m]."""
        return ZERO

    def body_force(self, body: Body) -> Vector:
        """Force through the centre of mass, body axes [N]."""
        return ZERO

    def body_moment(self, body: Body) -> Vector:
        """Moment about the centre of mass, body axes [N m]."""
        return ZERO

    def hidden_rate(self, body: Body) -> list[Number]:
        """Time derivatives of the effect's hidden states, `body.hidden[name]`."""
        return []

    # sensors
    def pose_delay(self) -> float:
        """Delay of attitude, position and velocity [s]."""
        return 0.0

    def imu_delay(self) -> float:
        """Delay of gyro and accelerometer [s]."""
        return 0.0

    def rotor_speed_delay(self) -> float:
        """Delay of the measured rotor speeds [s]."""
        return 0.0

    def imu_shift(self) -> Vector:
        """Shift of the IMU from where the airframe says it is, body [m]."""
        return ZERO

    def pose_shift(self) -> Vector:
        """Shift of the tracked point from the body origin, body [m]."""
        return ZERO

    def gyro(self, rates: Vector) -> Vector:
        """Gyro reading after this effect [rad/s]."""
        return rates

    def accelerometer(self, specific_force: Vector) -> Vector:
        """Accelerometer reading after this effect [m/s^2]."""
        return specific_force

    def attitude(self, q: Quaternion) -> Quaternion:
        """Attitude reading after this effect."""
        return q

    def rotor_speed(self, speeds: list[Number]) -> list[Number]:
        """Readings of all rotors after this effect [rad/s]."""
        return speeds


def hooks(effects: tuple[PlantEffect, ...], hook: str) -> list[Callable[..., Any]]:
    """The bound methods `hook` of those effects that override it, in the order of the stage's
    chain."""
    chosen = [e for e in effects if getattr(type(e), hook) is not getattr(PlantEffect, hook)]
    return [getattr(e, hook) for e in sorted(chosen, key=lambda e: e.order)]
