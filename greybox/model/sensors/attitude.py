"""Attitude: unit quaternion, body to world."""

from __future__ import annotations

import casadi as ca
import numpy as np

from greybox.frames import quat_conjugate, quat_multiply
from greybox.model.flow import Flow
from greybox.model.sensor import Sensor, Start, axes, first_complete
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr, FloatArray, Signal

TURNS = 2.0
"""A small rotation vector [rad] over the vector part of its quaternion."""


class Attitude(Sensor):
    """qw, qx, qy, qz [-]. The innovation is delta_theta [rad] in body axes, q = q_hat *
    exp(delta_theta / 2)."""

    name = "attitude"
    group = "rotation"
    summary = "attitude quaternion"
    clock = "pose"
    noisiest = 0.2
    noisiest_hint = "rad, not degrees"
    shows = "attitude"
    length = (0.5, 2.0)
    colour_time = 0.2

    def signals(self, vehicle: Vehicle) -> tuple[Signal, ...]:
        """qw, qx, qy, qz."""
        return axes("q", "wxyz", "-", "attitude quaternion, body to world")

    def innovation_signals(self, vehicle: Vehicle) -> tuple[Signal, ...]:
        """attitude.x, attitude.y, attitude.z."""
        return axes("attitude.", "xyz", "rad", "attitude innovation, body axes")

    def typical_noise(self, vehicle: Vehicle) -> float:
        """[rad]."""
        return 0.003

    def noise_of_columns(self, innovation: FloatArray) -> FloatArray:
        """The same in all four, as any of them may be the one that hardly changes."""
        return np.full(4, float(innovation.mean()) / TURNS)

    def noise_of_innovation(self, columns: FloatArray) -> FloatArray:
        """That of the vector part."""
        return TURNS * columns[1:]

    def starts(self, readings: FloatArray, t: FloatArray) -> tuple[Start, ...]:
        """The first attitude."""
        row = first_complete(readings)
        return (
            ()
            if row is None
            else (Start(block="attitude", value=row / np.linalg.norm(row), spread=(0.02,) * 3),)
        )

    def reading(self, flow: Flow, specific_force: Expr) -> Expr:
        """The attitude itself."""
        return flow.quaternion

    def innovation(self, y: Expr, y_hat: Expr, rotation: Expr) -> Expr:
        """Rotation vector by the vector part, 2 sign(w) v: exact to third order and without a
        singularity at pi."""
        d = quat_multiply(quat_conjugate(y_hat), y)
        return ca.if_else(d[0] < 0, -TURNS, TURNS) * d[1:4]
