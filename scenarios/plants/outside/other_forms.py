"""Families that the catalogue knows, in another form: other exponents, another dependence,
relaxation, hysteresis.

These stand together because each is a line or two of difference from its relative in
greybox.plants.effects.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from greybox.plants.effects.base import Body, Hub, PlantEffect
from greybox.plants.vectors import Number, Vector


@dataclass(frozen=True, kw_only=True)
class PowerDrag(PlantEffect):
    """F = -c v |v|^0.5: between rotor drag (power 1) and parasitic drag (power 2)."""

    name: ClassVar[str] = "power_drag"
    c: Number = 0.0

    def body_force(self, body: Body) -> Vector:
        """Drag [N]."""
        vx, vy, vz = body.airspeed
        scale = -self.c * (vx * vx + vy * vy + vz * vz + 1e-9) ** 0.25
        return (scale * vx, scale * vy, scale * vz)


@dataclass(frozen=True, kw_only=True)
class QuadraticDamping(PlantEffect):
    """tau_j = -d_j omega_j |omega_j|: relative of rotational_damping."""

    name: ClassVar[str] = "quadratic_damping"
    d: Number = 0.0

    def body_moment(self, body: Body) -> Vector:
        """Damping [N m]."""
        p, q, r = body.rates
        return (-self.d * p * np.abs(p), -self.d * q * np.abs(q), -self.d * r * np.abs(r))


@dataclass(frozen=True, kw_only=True)
class ExponentialGround(PlantEffect):
    """T_i (1 + a exp(-z / height)): relative of ground_effect."""

    name: ClassVar[str] = "exponential_ground"
    a: Number = 0.0
    height: Number = 0.4

    def thrust_factor(self, hub: Hub) -> Number:
        """Factor on the thrust."""
        return 1.0 + self.a * np.exp(-hub.body.position[2] / self.height)


@dataclass(frozen=True, kw_only=True)
class RelaxingDrag(PlantEffect):
    """F = -k v_f, the wake's velocity v_f (body axes) follows the airspeed within `time` [s]:
    relative of rotor_drag."""

    name: ClassVar[str] = "relaxing_drag"
    hidden: ClassVar[int] = 3
    k: Number = 0.0
    time: Number = 0.3

    def body_force(self, body: Body) -> Vector:
        """Drag [N]."""
        a, b, c = body.hidden[self.name]
        return (-self.k * a, -self.k * b, -0.3 * self.k * c)

    def hidden_rate(self, body: Body) -> list[Number]:
        """The wake follows."""
        return [(v - h) / self.time for v, h in zip(body.airspeed, body.hidden[self.name])]


@dataclass(frozen=True, kw_only=True)
class HystereticDamping(PlantEffect):
    """tau = -d z with Bouc-Wen states z (Wen 1976): z' = A omega - beta |omega| z |z| - gamma omega
    z^2: relative of rotational_damping whose moment remembers the path."""

    name: ClassVar[str] = "hysteretic_damping"
    hidden: ClassVar[int] = 3
    d: Number = 0.0
    stiffness: Number = 8.0
    beta: Number = 4.0
    gamma: Number = 4.0

    def body_moment(self, body: Body) -> Vector:
        """Moment [N m]."""
        a, b, c = body.hidden[self.name]
        return (-self.d * a, -self.d * b, -self.d * c)

    def hidden_rate(self, body: Body) -> list[Number]:
        """Bouc-Wen."""
        return [
            self.stiffness * w - self.beta * np.abs(w) * z * np.abs(z) - self.gamma * w * z * z
            for w, z in zip(body.rates, body.hidden[self.name])
        ]
