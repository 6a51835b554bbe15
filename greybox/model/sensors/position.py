"""Position: of the body origin, world frame."""

from __future__ import annotations

from typing import Any

from greybox.model.effect import Flow
from greybox.model.sensor import Sensor, axes
from greybox.symbolic import Expr, Signal


class Position(Sensor):
    """x, y, z [m] of the body origin. The innovation is turned into body axes, so that its gain does not depend on yaw."""

    name = "position"
    group = "position"
    summary = "position of the body origin"

    def signals(self, vehicle: Any) -> tuple[Signal, ...]:
        """x, y, z."""
        return axes("", "xyz", "m", "position, world")

    def innovation_signals(self, vehicle: Any) -> tuple[Signal, ...]:
        """position.x, position.y, position.z."""
        return axes("position.", "xyz", "m", "position innovation, body axes")

    def reading(self, flow: Flow, specific_force: Expr) -> Expr:
        """p - R c, c the centre of mass from the body origin."""
        return flow.position - flow.rotation @ flow.center_of_mass

    def innovation(self, y: Expr, y_hat: Expr, rotation: Expr) -> Expr:
        """R^T (y - y_hat)."""
        return rotation.T @ (y - y_hat)
