"""Craft: a vehicle with the figures that its plausibility is judged by, thrust through the model's
own equations."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TypeVar

import casadi as ca
import numpy as np

from greybox.model.effects import effect_by_name
from greybox.model.model import PhysicsModel
from greybox.model.vehicle import Vehicle
from greybox.symbolic import FloatArray

AIR = 1.225
"""Density of air at sea level [kg/m^3]."""
HOVER_RANGE = (0.15, 0.85)
"""Shares of the command range that leave a hover room to both sides."""

Nu = TypeVar("Nu", float, FloatArray)
FIGURES = (
    "mass",
    "arm_length",
    "thrust_to_weight",
    "hover_command",
    "torque_over_thrust",
    "tip_speed",
    "thrust_coefficient",
)


class Craft:
    """A vehicle with its derived figures."""

    def __init__(self, vehicle: Vehicle) -> None:
        self.vehicle, self.n = vehicle, vehicle.n_rotors
        self.m, self.L = vehicle.mass.value, vehicle.arm_length
        self.weight = self.m * vehicle.gravity
        self.place = np.array([r.position for r in vehicle.rotors], dtype=float)
        self.spin = np.array([r.spin for r in vehicle.rotors], dtype=float)
        low, high = vehicle.actuator.u_min, vehicle.actuator.u_max
        self.u = np.linspace(low, high, 201)
        self.lift = _lift(vehicle, self.u, plain=not effects_fit(vehicle))  # N, all rotors at u
        self.rotor = self.polynomial("thrust", self.u)
        enough = self.lift >= self.weight
        self.hover = (
            float(np.interp(self.weight, self.lift, self.u))
            if enough.any() and not enough[0]
            else None
        )
        at = self.u[-1] if self.hover is None else self.hover
        thrust, torque = float(self.polynomial("thrust", at)), float(self.polynomial("torque", at))
        self.lever = torque / thrust if thrust > 0 else None
        radius, speed = vehicle.actuator.rotor_radius, vehicle.actuator.speed_max
        self.tip = speed * radius if speed and radius else None
        area = math.pi * radius**2 if radius else None
        pressure = AIR * area * self.tip**2 if area and self.tip else 0.0
        self.coefficient = float(self.rotor[-1]) / pressure if pressure > 0 else None
        ratio = float(self.lift[-1]) / self.weight
        values = (self.m, self.L, ratio, self.hover, self.lever, self.tip, self.coefficient)
        self.figures: dict[str, float | None] = dict(zip(FIGURES, values, strict=True))

    def share_of(self, commands: float | FloatArray) -> FloatArray:
        """Where commands stand in their range, 0 to 1."""
        return np.asarray((commands - self.u[0]) / (self.u[-1] - self.u[0]), dtype=np.float64)

    def polynomial(self, kind: str, nu: Nu) -> Nu:
        """Thrust or torque of one rotor at normalised speed."""
        return sum(q.value * nu**k for k, q in enumerate(getattr(self.vehicle.actuator, kind)))


def _lift(vehicle: Vehicle, u: FloatArray, *, plain: bool) -> FloatArray:
    """Steady thrust of all rotors [N] at the commands u (n,), far from the ground, with the effects
    that the file states."""
    n = vehicle.n_rotors
    if plain:
        return n * np.asarray(sum(q.value * u**k for k, q in enumerate(vehicle.actuator.thrust)))
    effects = [effect_by_name(name) for name in vehicle.effects]
    effects = [
        e
        for e in effects
        if e.stage in ("command", "rotor", "thrust") and not {"lag", "delay"} & set(e.early)
    ]
    known = {k: v for k, v in vehicle.effects.items() if k in {e.name for e in effects}}
    model = PhysicsModel(vehicle=replace(vehicle, effects=known), effects=tuple(effects))
    command = ca.SX.sym("u")
    x = ca.DM(model.reference({}))
    x[2] = 1e3
    p = ca.DM([d.nominal for d in model.parameters])
    inputs = ca.vertcat(
        *([command] * n), *([vehicle.nominal_voltage or 1.0] * (len(model.inputs) - n))
    )
    up = model.f(0, x, inputs, p)[model.states.names.index("velocity.z")] + vehicle.gravity
    return (
        vehicle.mass.value * np.asarray(ca.Function("lift", [command], [up]).map(u.size)(u)).ravel()
    )


def effects_fit(vehicle: Vehicle) -> bool:
    """Whether every parameter of the stated effects lies inside its declared bounds. Raises
    `UnknownNameError`."""
    for name, given in vehicle.effects.items():
        declared = {d.name: d for d in effect_by_name(name).parameters(vehicle)}
        if any(
            k in declared and not declared[k].lower <= q.value <= declared[k].upper
            for k, q in given.items()
        ):
            return False
    return True
