"""Effects that act on a foreign craft from outside: a force and a moment on its body, a change of
its commands, of its readings.

A simulator does by itself what it can (`hidden.settled`); the hooks of the remaining
`greybox.plants.effects` are asked here for the force and moment that they add at the present
motion. Nothing of greybox is used.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from greybox.plants.airframe import Airframe
from greybox.plants.effects.base import Body, Hub, PlantEffect, hooks
from greybox.plants.vectors import (
    ZERO,
    Quaternion,
    Vector,
    add,
    apply_transposed,
    cross,
    rotation,
    subtract,
)
from scenarios.foreign.craft import Craft


class Load(NamedTuple):
    """A force through the centre of mass [N] and a moment about it [N m], body axes."""

    force: Vector = ZERO
    moment: Vector = ZERO

    def plus(self, other: Load) -> Load:
        """Both together."""
        return Load(add(self.force, other.force), add(self.moment, other.moment))


class Instant(NamedTuple):
    """What effects see of a craft: centre of mass, world; rates, body; speeds as nu and their rates
    of change [1/s]; wind, world; battery voltage [V]."""

    time: float
    position: Vector
    velocity: Vector
    attitude: Quaternion
    rates: Vector
    nu: tuple[float, ...]
    nu_rate: tuple[float, ...]
    wind: Vector
    voltage: float


class Loads:
    """The outside effects of one craft in flight, their hidden states included."""

    def __init__(self, effects: Sequence[PlantEffect], craft: Craft) -> None:
        self.effects = tuple(effects)
        self._frame: Airframe = craft.airframe
        self._scale = craft.speed_max
        center = craft.airframe.center_of_mass
        self._arms = [subtract(rotor.position, center) for rotor in self._frame.rotors]
        self._thrust_factors = hooks(self.effects, "thrust_factor")
        self._torque_factors = hooks(self.effects, "torque_factor")
        self._increments = hooks(self.effects, "thrust_increment")
        self._hub_forces = hooks(self.effects, "hub_force")
        self._hub_moments = hooks(self.effects, "hub_moment")
        self._body_forces = hooks(self.effects, "body_force")
        self._body_moments = hooks(self.effects, "body_moment")
        self._shapes = hooks(self.effects, "command")
        self._gyro = hooks(self.effects, "gyro")
        self._accelerometer = hooks(self.effects, "accelerometer")
        self._attitude = hooks(self.effects, "attitude")
        self._hub = bool(
            self._thrust_factors
            or self._torque_factors
            or self._increments
            or self._hub_forces
            or self._hub_moments
        )
        self.push = bool(self._hub or self._body_forces or self._body_moments)
        """Whether anything acts by force or moment."""
        self.imu_delay = float(sum(e.imu_delay() for e in self.effects))
        self.pose_delay = float(sum(e.pose_delay() for e in self.effects))
        self.pose_shift = ZERO
        for e in self.effects:
            self.pose_shift = add(self.pose_shift, e.pose_shift())
        self.reset()

    def reset(self) -> None:
        """Forget the hidden states."""
        self._hidden = {e.name: [0.0] * e.hidden for e in self.effects if e.hidden}

    def command(self, u: float) -> float:
        """Command of one rotor after the effects."""
        for shape in self._shapes:
            u = float(shape(u))
        return u

    def readings(
        self, gyro: Vector, felt: Vector, attitude: Quaternion
    ) -> tuple[Vector, Vector, Quaternion]:
        """Gyro, accelerometer and attitude as the sensors give them, without noise."""
        for hook in self._gyro:
            gyro = hook(gyro)
        for hook in self._accelerometer:
            felt = hook(felt)
        for hook in self._attitude:
            attitude = hook(attitude)
        return gyro, felt, attitude

    def at(self, now: Instant) -> Load:
        """What the effects add now."""
        body = self._body(now)
        load = Load()
        for hook in self._body_forces:
            load = load.plus(Load(_floats(hook(body))))
        for hook in self._body_moments:
            load = load.plus(Load(ZERO, _floats(hook(body))))
        return load.plus(self._hubs(body)) if self._hub else load

    def advance(self, now: Instant, duration: float) -> None:
        """Let the hidden states run for `duration` [s] (one Euler step)."""
        if self._hidden:
            body = self._body(now)
            for e in self.effects:
                if e.hidden:
                    rates = e.hidden_rate(body)
                    old = self._hidden[e.name]
                    self._hidden[e.name] = [float(x + duration * r) for x, r in zip(old, rates)]

    def _body(self, now: Instant) -> Body:
        body = Body()
        body.time, body.position, body.velocity = now.time, now.position, now.velocity
        body.attitude, body.rotation, body.rates = now.attitude, rotation(now.attitude), now.rates
        body.wind = now.wind
        body.airspeed = apply_transposed(body.rotation, subtract(now.velocity, now.wind))
        body.nu, body.nu_rate = list(now.nu), list(now.nu_rate)
        body.speed = [self._scale * n for n in now.nu]
        body.speed_rate = [self._scale * n for n in now.nu_rate]
        body.voltage = now.voltage
        body.hidden = {name: list(values) for name, values in self._hidden.items()}
        return body

    def _hubs(self, body: Body) -> Load:
        load = Load()
        (t0, t1, t2), (q0, q1, q2) = self._frame.thrust, self._frame.torque
        for i, (arm, rotor) in enumerate(zip(self._arms, self._frame.rotors)):
            nu = body.nu[i]
            thrust, torque = t0 + nu * (t1 + nu * t2), q0 + nu * (q1 + nu * q2)
            airspeed = add(body.airspeed, cross(body.rates, arm))
            hub = Hub(i, rotor.spin, arm, airspeed, nu, body.speed[i], thrust, torque, body)
            more, drag = 0.0, 0.0
            for hook in self._thrust_factors:
                more += (thrust + more) * (float(hook(hub)) - 1.0)
            for hook in self._torque_factors:
                drag += (torque + drag) * (float(hook(hub)) - 1.0)
            more += sum(float(hook(hub)) for hook in self._increments)
            force: Vector = (0.0, 0.0, more)
            moment: Vector = (0.0, 0.0, -rotor.spin * drag)
            for hook in self._hub_forces:
                force = add(force, _floats(hook(hub)))
            for hook in self._hub_moments:
                moment = add(moment, _floats(hook(hub)))
            load = load.plus(Load(force, add(moment, cross(arm, force))))
        return load


def _floats(values: Sequence[float | np.floating]) -> Vector:
    x, y, z = (float(v) for v in values)
    return (x, y, z)
