"""Gyro: body rate."""

from __future__ import annotations

from greybox.model.flow import Flow
from greybox.model.sensor import Sensor, Start, axes, first_complete
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr, FloatArray, Signal


class Gyro(Sensor):
    """p, q, r [rad/s]: the body rate, the same at every point of the body."""

    name = "gyro"
    group = "rate"
    summary = "body rate omega"
    noisiest = 0.5
    noisiest_hint = "rad/s, not deg/s"
    shows = "rate"
    colour_time = 0.05
    witnesses = frozenset({"attitude"})

    def signals(self, vehicle: Vehicle) -> tuple[Signal, ...]:
        """p, q, r."""
        return axes("", "pqr", "rad/s", "body rate")

    def innovation_signals(self, vehicle: Vehicle) -> tuple[Signal, ...]:
        """p, q, r."""
        return self.signals(vehicle)

    def typical_noise(self, vehicle: Vehicle) -> float:
        """[rad/s]."""
        return 0.02

    def starts(self, readings: FloatArray, t: FloatArray) -> tuple[Start, ...]:
        """The first body rate."""
        row = first_complete(readings)
        return () if row is None else (Start(block="rate", value=row, spread=(0.2,) * 3),)

    def reading(self, flow: Flow, specific_force: Expr) -> Expr:
        """Omega."""
        return flow.omega
