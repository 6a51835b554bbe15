"""An effect with states of its own, for the tests: the catalogue has none."""

from __future__ import annotations

import casadi as ca

from greybox.model.effect import Effect, Remembered
from greybox.model.parameter import Parameter


class Wake(Effect):
    """Drag by a wake that follows the vehicle: what `RelaxingDrag` of the plants does, written
    anew."""

    name = "wake"
    stage = "wrench"
    summary = "drag by the velocity of a wake that follows the vehicle's"
    formula = "F = -k (m_x, m_y, 0.3 m_z), dm/dt = (v - m)/T"

    def parameters(self, vehicle):
        k = Parameter(name="k", unit="N s/m", nominal=0.0, null=0.0, scale=0.1, meaning="drag")
        time = Parameter(
            name="T",
            unit="s",
            nominal=0.2,
            null=0.2,
            lower=0.01,
            upper=30.0,
            scale=0.1,
            meaning="relaxation",
        )
        return (k, time)

    def memory(self, vehicle):
        return tuple(Remembered(name=a, unit="m/s", size=0.5) for a in "xyz")

    def remember(self, flow, p):
        return (flow.velocity - flow.memory) / p["T"]

    def apply(self, flow, p):
        return {"force": -p["k"] * ca.vertcat(flow.memory[0], flow.memory[1], 0.3 * flow.memory[2])}
