"""Two sensors of a user's own, each one class: a barometer that drifts and a magnetometer that
shows the heading."""

from __future__ import annotations

import casadi as ca
import numpy as np

from greybox.model.flow import Flow, Remembered
from greybox.model.sensor import Sensor, Start, axes, first_complete
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr, FloatArray, Signal

FIELD = (0.0, 0.5, -(0.75**0.5))
"""Direction of the earth's field, world axes (x east, y north, z up), where it dips by 60
degrees."""


class Barometer(Sensor):
    """baro [m]: height above the start, with a bias b that walks at random, y = z + b."""

    name = "barometer"
    group = "height"
    summary = "height above the start"
    clock = "now"

    def signals(self, vehicle: Vehicle) -> tuple[Signal, ...]:
        """baro."""
        return (Signal(name="baro", unit="m", meaning="height above the start"),)

    def innovation_signals(self, vehicle: Vehicle) -> tuple[Signal, ...]:
        """baro."""
        return self.signals(vehicle)

    def typical_noise(self, vehicle: Vehicle) -> float:
        """[m]."""
        return 0.2

    def memory(self, vehicle: Vehicle) -> tuple[Remembered, ...]:
        """The bias, which also takes up where the height is counted from."""
        return (Remembered(name="bias", unit="m", size=1.0, drift=0.02),)

    def reading(self, flow: Flow, specific_force: Expr) -> Expr:
        """Height and bias."""
        return flow.position[2] + flow.memory


class Magnetometer(Sensor):
    """mx, my, mz [-]: direction of the earth's field in body axes, R^T m.

    Its innovation is the error of heading alone, the angle between the level parts of what was
    measured and predicted: it means the same at every heading, which components in body axes would
    not.
    """

    name = "magnetometer"
    group = "field"
    summary = "direction of the earth's field"

    def signals(self, vehicle: Vehicle) -> tuple[Signal, ...]:
        """mx, my, mz."""
        return axes("m", "xyz", "-", "direction of the earth's field, body axes")

    def innovation_signals(self, vehicle: Vehicle) -> tuple[Signal, ...]:
        """magnetometer.heading."""
        return (
            Signal(name="magnetometer.heading", unit="rad", meaning="innovation of the heading"),
        )

    def typical_noise(self, vehicle: Vehicle) -> tuple[float, ...]:
        """[rad]."""
        return (0.05,)

    def starts(self, readings: FloatArray, t: FloatArray) -> tuple[Start, ...]:
        """The heading of a craft that is nearly level."""
        row = first_complete(readings)
        if row is None:
            return ()
        half = 0.5 * (np.arctan2(FIELD[1], FIELD[0]) - np.arctan2(row[1], row[0]))
        level = (np.cos(half), 0.0, 0.0, np.sin(half))
        return (Start(block="attitude", value=level, spread=(0.1, 0.1, 0.3)),)

    def reading(self, flow: Flow, specific_force: Expr) -> Expr:
        """R^T m."""
        return flow.rotation.T @ ca.DM(FIELD)

    def innovation(self, y: Expr, y_hat: Expr, rotation: Expr) -> Expr:
        """The turn about the vertical that carries the measured direction into the predicted
        one."""
        a, b = rotation @ y, rotation @ y_hat
        return (b[1] * a[0] - b[0] * a[1]) / (b[0] ** 2 + b[1] ** 2)
