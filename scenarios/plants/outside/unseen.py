"""Effects invented by another hand, without knowledge of the search: they judge, nothing is tuned
on them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from greybox.plants.effects.base import Body, Hub, PlantEffect
from greybox.plants.vectors import ZERO, Number, Vector, add, apply, apply_transposed


@dataclass(frozen=True, kw_only=True)
class MunkMoment(PlantEffect):
    """A long light hull along body x turns broadside to the flow (Munk 1924, NACA Report 184): a
    moment without a force.

        tau = -v x (M v), M = diag(0, k, k)   =>   tau = k v_x (0, v_z, -v_y)

    k [kg]: difference of the added masses across and along the hull, about 0.7 rho volume for a
    slender one.
    """

    name: ClassVar[str] = "munk_moment"
    k: Number = 0.0

    def body_moment(self, body: Body) -> Vector:
        """Moment [N m]."""
        vx, vy, vz = body.airspeed
        return (0.0, self.k * vx * vz, -self.k * vx * vy)


@dataclass(frozen=True, kw_only=True)
class AirOutlet(PlantEffect):
    """The round jet of an air outlet in the ceiling blows down on a spot of the room and takes
    thrust from each rotor that is inside it (round free jet: it widens linearly, its centre slows
    down as its width grows).

        b = width + spread (top - z),   w = (width / b) exp(-((x - x_0)^2 + (y - y_0)^2) / b^2),   dT_i = -loss nu_i w R_33

    at the hub's place (x, y, z), world; loss [N]: lift slope of a rotor at nu = 1 times the speed
    of the jet at the outlet; x_0, y_0, top, width [m].
    """

    name: ClassVar[str] = "air_outlet"
    loss: Number = 0.0
    x_0: Number = 0.4
    y_0: Number = -0.3
    top: Number = 3.0
    width: Number = 0.5
    spread: Number = 0.11

    def thrust_increment(self, hub: Hub) -> Number:
        """Thrust lost by one rotor [N]."""
        body = hub.body
        x, y, z = add(body.position, apply(body.rotation, hub.arm))
        b = self.width + self.spread * (self.top - z)
        jet = self.width / b * np.exp(-((x - self.x_0) ** 2 + (y - self.y_0) ** 2) / (b * b))
        upright = apply_transposed(body.rotation, (0.0, 0.0, 1.0))[2]
        return -self.loss * hub.nu * jet * upright


@dataclass(frozen=True, kw_only=True)
class PlateInWake(PlantEffect):
    """A plate (foot, pod) stands below a rotor just outside its wake; flight towards the other side
    blows the wake on to it, as the wake of a helicopter meets its tailplane at low speed (Prouty,
    Helicopter Performance, Stability, and Control).

        e = -(drop / (wake nu)) (v . d) - gap,   F = (0, 0, -load T (1 + tanh(e / edge)) / 2) at the hub

    d = (cos azimuth, sin azimuth, 0) points from the hub to the plate, body; v: airspeed of the
    hub; drop: plate below the disc [m]; wake: speed of the wake at nu = 1 [m/s]; gap, edge:
    distance to the wake and softness of its edge [m]; load: share of the thrust T that the plate
    catches when it is all inside. rotor counts from 0.
    """

    name: ClassVar[str] = "plate_in_wake"
    load: Number = 0.0
    drop: Number = 0.15
    wake: Number = 20.0
    gap: Number = 0.016
    edge: Number = 0.005
    azimuth: Number = 2.4
    rotor: int = 2

    def hub_force(self, hub: Hub) -> Vector:
        """Download on the plate [N]."""
        if hub.index != self.rotor:
            return ZERO
        vx, vy, _ = hub.airspeed
        along = vx * np.cos(self.azimuth) + vy * np.sin(self.azimuth)
        inside = -self.drop * along / (self.wake * hub.nu) - self.gap
        return (0.0, 0.0, -0.5 * self.load * hub.thrust * (1.0 + np.tanh(inside / self.edge)))


@dataclass(frozen=True, kw_only=True)
class LooseArm(PlantEffect):
    """A folding arm with a worn lock sits at one of two stops, where its rotor leans to one side or
    the other; the air that pushes the rotor sideways throws it over, and it stays there (two seats
    with hysteresis, the cusp's normal form).

        time s' = s - s^3 - c (v . e) / flip,   c = 2 / sqrt(27),   F = tilt s T e at the hub

    e = (-sin azimuth, cos azimuth, 0) is across the arm, body; v: airspeed of the centre of mass; s
    near +-1: the seat, which is left as soon as |v . e| exceeds flip [m/s]; tilt [rad]; azimuth of
    the arm [rad]; rotor counts from 0.
    """

    name: ClassVar[str] = "loose_arm"
    hidden: ClassVar[int] = 1
    tilt: Number = 0.0
    flip: Number = 0.8
    time: Number = 0.04
    azimuth: Number = -0.7853981633974483
    rotor: int = 0

    def hub_force(self, hub: Hub) -> Vector:
        """Side force of the leaning rotor [N]."""
        if hub.index != self.rotor:
            return ZERO
        side = self.tilt * hub.body.hidden[self.name][0] * hub.thrust
        return (-side * np.sin(self.azimuth), side * np.cos(self.azimuth), 0.0)

    def hidden_rate(self, body: Body) -> list[Number]:
        """The seat."""
        (s,) = body.hidden[self.name]
        vx, vy, _ = body.airspeed
        across = vy * np.cos(self.azimuth) - vx * np.sin(self.azimuth)
        return [(s - s * s * s - 2.0 / 27.0**0.5 * across / self.flip) / self.time]


@dataclass(frozen=True, kw_only=True)
class ReturningWake(PlantEffect):
    """In a small room the air that a tilted vehicle throws sideways runs to the wall and comes back
    as a gust, `time` [s] later, against the direction in which it was thrown: a transport delay,
    here six equal lags in a row per direction.

        g_j' = (6 / time) (g_(j-1) - g_j), j = 1..6,   g_0 = (R e_z)_xy sum(nu^2) / (n reference^2),   F_xy = push g_6

    push [N] is the gust's force per unit of horizontal thrust in hover thrusts; g and F_xy in world
    axes.
    """

    name: ClassVar[str] = "returning_wake"
    hidden: ClassVar[int] = 12
    push: Number = 0.0
    time: Number = 0.9
    reference: Number = 0.54

    def body_force(self, body: Body) -> Vector:
        """Push of the gust, body axes [N]."""
        g = body.hidden[self.name]
        return apply_transposed(body.rotation, (self.push * g[5], self.push * g[11], 0.0))

    def hidden_rate(self, body: Body) -> list[Number]:
        """Six lags in a row along world x, then six along world y."""
        g = body.hidden[self.name]
        tilt = apply(body.rotation, (0.0, 0.0, 1.0))
        power = sum(n * n for n in body.nu) / (len(body.nu) * self.reference**2)
        into = [power * tilt[0], *g[:5], power * tilt[1], *g[6:11]]
        return [6.0 / self.time * (a - b) for a, b in zip(into, g)]
