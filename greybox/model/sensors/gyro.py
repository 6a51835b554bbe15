"""Gyro: body rate."""

from __future__ import annotations

from typing import Any

from greybox.model.effect import Flow
from greybox.model.sensor import Sensor, axes
from greybox.symbolic import Expr, Signal


class Gyro(Sensor):
    """p, q, r [rad/s]: the body rate, the same at every point of the body."""

    name = "gyro"
    group = "rate"
    summary = "body rate omega"

    def signals(self, vehicle: Any) -> tuple[Signal, ...]:
        """p, q, r."""
        return axes("", "pqr", "rad/s", "body rate")

    def innovation_signals(self, vehicle: Any) -> tuple[Signal, ...]:
        """p, q, r."""
        return self.signals(vehicle)

    def reading(self, flow: Flow, specific_force: Expr) -> Expr:
        """Omega."""
        return flow.omega
