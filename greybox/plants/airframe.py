"""What a simulated vehicle is made of: mass, inertia, rotors, thrust and torque maps. Plain
numbers, SI units.

Every number may also be an array of shape (B,), one value per member of a batch, so that a Monte
Carlo over true parameters runs as one flight of the batch.
"""

from __future__ import annotations

from dataclasses import dataclass

from greybox.plants.vectors import ZERO, Matrix, Number, Vector


@dataclass(frozen=True)
class Rotor:
    """One rotor: hub position from the body origin [m], forward-left-up; spin +1 counter-clockwise
    from above."""

    position: Vector
    spin: int


@dataclass(frozen=True, kw_only=True)
class Airframe:
    """A rigid body with n rotors.

    mass [kg]; inertia = (xx, yy, zz) and products = (xy, xz, yz), the elements of the inertia
    matrix about the centre of mass [kg m^2]; center_of_mass and imu_position from the body origin
    [m]; thrust = (c0, c1, c2) with T = c0 + c1 nu + c2 nu^2 [N] per rotor, torque likewise [N m],
    nu the normalised rotor speed; speed_max [rad/s] is the speed at nu = 1 (None: speeds are
    reported as nu times 1 rad/s); gravity [m/s^2].
    """

    name: str
    mass: Number
    inertia: Vector
    rotors: tuple[Rotor, ...]
    thrust: Vector
    torque: Vector
    products: Vector = ZERO
    center_of_mass: Vector = ZERO
    imu_position: Vector = ZERO
    speed_max: float | None = None
    rotor_radius: float | None = None
    gravity: float = 9.80665
    u_min: float = 0.0
    u_max: float = 1.0
    nominal_voltage: float | None = None

    def __post_init__(self) -> None:
        if not self.rotors:
            raise ValueError("airframe without rotors: give at least one Rotor(position, spin)")
        for number, rotor in enumerate(self.rotors, 1):
            if rotor.spin not in (-1, 1):
                raise ValueError(
                    f"rotor {number}: spin must be +1 (counter-clockwise) or -1, got {rotor.spin}"
                )

    @property
    def inertia_matrix(self) -> Matrix:
        """The nine elements of the inertia matrix about the centre of mass [kg m^2]."""
        xx, yy, zz = self.inertia
        xy, xz, yz = self.products
        return (xx, xy, xz, xy, yy, yz, xz, yz, zz)

    def command_for_thrust(self, thrust: Number) -> Number:
        """Normalised rotor speed nu at which one rotor gives `thrust` [N] (the map inverted on its
        rising branch)."""
        c0, c1, c2 = self.thrust
        if isinstance(c2, float) and c2 == 0.0:
            return (thrust - c0) / c1
        inside = c1 * c1 + 4.0 * c2 * (thrust - c0)
        return ((inside * (inside > 0.0)) ** 0.5 - c1) / (2.0 * c2)

    @property
    def hover_speed(self) -> Number:
        """Normalised rotor speed nu at which the rotors together carry the weight."""
        return self.command_for_thrust(self.mass * self.gravity / len(self.rotors))

    def parameters(self) -> dict[str, Number]:
        """True values by canonical name."""
        names = dict(zip(("inertia.xx", "inertia.yy", "inertia.zz"), self.inertia))
        names |= dict(zip(("inertia.xy", "inertia.xz", "inertia.yz"), self.products))
        names |= {f"thrust.c{k}": c for k, c in enumerate(self.thrust)}
        names |= {f"torque.c{k}": c for k, c in enumerate(self.torque)}
        names |= dict(
            zip(("center_of_mass.x", "center_of_mass.y", "center_of_mass.z"), self.center_of_mass)
        )
        return {"mass": self.mass, **names}


def x_layout(arm_x: float, arm_y: float) -> tuple[Rotor, ...]:
    """Four rotors in X: front right (CCW), rear right (CW), rear left (CCW), front left (CW); half
    distances [m]."""
    return (
        Rotor((arm_x, -arm_y, 0.0), 1),
        Rotor((-arm_x, -arm_y, 0.0), -1),
        Rotor((-arm_x, arm_y, 0.0), 1),
        Rotor((arm_x, arm_y, 0.0), -1),
    )


def plus_layout(arm: float) -> tuple[Rotor, ...]:
    """Four rotors in plus: front, left, back, right, the first and third clockwise; arm [m]."""
    return (
        Rotor((arm, 0.0, 0.0), -1),
        Rotor((0.0, arm, 0.0), 1),
        Rotor((-arm, 0.0, 0.0), -1),
        Rotor((0.0, -arm, 0.0), 1),
    )
