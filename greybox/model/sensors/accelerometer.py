"""Accelerometer: specific force at the IMU."""

from __future__ import annotations

import casadi as ca

from greybox.model.flow import Flow
from greybox.model.sensor import Sensor, axes
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr, Signal


class Accelerometer(Sensor):
    """ax, ay, az [m/s^2]: (F - m g)/m at the centre of mass plus the lever arm of the IMU.

    a_imu = a_com + domega x r + omega x (omega x r), r from the centre of mass to the IMU.
    """

    name = "accelerometer"
    group = "specific_force"
    summary = "specific force at the IMU"
    noisiest = 10.0
    noisiest_hint = "m/s^2"
    colour_time = 0.05
    witnesses = frozenset({"velocity", "position"})

    def signals(self, vehicle: Vehicle) -> tuple[Signal, ...]:
        """ax, ay, az."""
        return axes("a", "xyz", "m/s^2", "specific force")

    def innovation_signals(self, vehicle: Vehicle) -> tuple[Signal, ...]:
        """ax, ay, az."""
        return self.signals(vehicle)

    def typical_noise(self, vehicle: Vehicle) -> float:
        """[m/s^2]."""
        return 0.1

    def reading(self, flow: Flow, specific_force: Expr) -> Expr:
        """Specific force with lever arm."""
        r = ca.DM(list(flow.vehicle.imu_position)) - flow.center_of_mass
        omega = flow.omega
        return (
            specific_force
            + ca.cross(flow.angular_acceleration, r)
            + ca.cross(omega, ca.cross(omega, r))
        )
