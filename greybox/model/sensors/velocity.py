"""Velocity: of the body origin, world frame."""

from __future__ import annotations

import casadi as ca

from greybox.model.flow import Flow
from greybox.model.sensor import Sensor, Start, axes, first_complete
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr, FloatArray, Signal


class Velocity(Sensor):
    """vx, vy, vz [m/s] of the body origin, world axes. The innovation is turned into body axes."""

    name = "velocity"
    group = "velocity"
    summary = "velocity of the body origin"
    clock = "pose"
    noisiest = 2.0
    noisiest_hint = "m/s, not mm/s"
    shows = "velocity"
    colour_time = 0.2
    world = True

    def signals(self, vehicle: Vehicle) -> tuple[Signal, ...]:
        """vx, vy, vz."""
        return axes("v", "xyz", "m/s", "velocity, world")

    def innovation_signals(self, vehicle: Vehicle) -> tuple[Signal, ...]:
        """velocity.x, velocity.y, velocity.z."""
        return axes("velocity.", "xyz", "m/s", "velocity innovation, body axes")

    def typical_noise(self, vehicle: Vehicle) -> float:
        """[m/s]."""
        return 0.02

    def starts(self, readings: FloatArray, t: FloatArray) -> tuple[Start, ...]:
        """The first velocity."""
        row = first_complete(readings)
        return () if row is None else (Start(block="velocity", value=row, spread=(0.1,) * 3),)

    def reading(self, flow: Flow, specific_force: Expr) -> Expr:
        """v - R (omega x c), c the centre of mass from the body origin."""
        return flow.velocity_world - flow.rotation @ ca.cross(flow.omega, flow.center_of_mass)
