"""Position: of the body origin, world frame."""

from __future__ import annotations

import numpy as np

from greybox.model.flow import Flow
from greybox.model.sensor import Sensor, Start, axes, first_complete
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr, FloatArray, Signal


class Position(Sensor):
    """x, y, z [m] of the body origin. The innovation is turned into body axes, so that its gain
    does not depend on yaw."""

    name = "position"
    group = "position"
    summary = "position of the body origin"
    clock = "pose"
    noisiest = 1.0
    noisiest_hint = "m, not mm"
    shows = "position"
    colour_time = 0.2
    world = True

    def signals(self, vehicle: Vehicle) -> tuple[Signal, ...]:
        """x, y, z."""
        return axes("", "xyz", "m", "position, world")

    def innovation_signals(self, vehicle: Vehicle) -> tuple[Signal, ...]:
        """position.x, position.y, position.z."""
        return axes("position.", "xyz", "m", "position innovation, body axes")

    def typical_noise(self, vehicle: Vehicle) -> float:
        """[m]."""
        return 0.001

    def starts(self, readings: FloatArray, t: FloatArray) -> tuple[Start, ...]:
        """The first position, and as velocity the slope of the straight line through the track."""
        row, good = first_complete(readings), np.isfinite(readings).all(axis=1)
        found = [] if row is None else [Start(block="position", value=row, spread=(0.01,) * 3)]
        if t.size == len(readings) and good.sum() > 2:
            slope = np.polyfit(t[good] - t[good][0], readings[good], 1)[0]
            found.append(Start(block="velocity", value=slope, spread=(0.3,) * 3))
        return tuple(found)

    def reading(self, flow: Flow, specific_force: Expr) -> Expr:
        """p - R c, c the centre of mass from the body origin."""
        return flow.position - flow.rotation @ flow.center_of_mass
