"""gyro_bias: a constant offset of the gyro."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca

from greybox.model.effect import Effect, Flow, Needs, ReferenceCase, vector_parameters
from greybox.model.parameter import Parameter
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr

POSSIBLE = 1.3
"""Largest offset that a sensor has [rad/s]: 75 deg/s, the widest zero-rate level of a data sheet
(L3G4200D at 2000 deg/s). More is another axis or another unit."""


class GyroBias(Effect):
    """omega_meas = omega + b, constant during a flight."""

    name = "gyro_bias"
    stage = "sensor"
    summary = "constant offset of the gyro"
    formula = "omega_meas = omega + b"
    references = (
        "Woodman 2007, An introduction to inertial navigation, Cambridge UCAM-CL-TR-696, sec. 3-4",
    )
    validity = "constant over a flight"
    tags = frozenset({"linear-in-parameters"})
    needs = Needs(sensors=("gyro",))
    order = 40
    case = ReferenceCase(
        parameters={"b_x": 0.01, "b_y": -0.02, "b_z": 0.03},
        flow={"measured": (0.5, 1.0, -2.0)},
        expected={"gyro": (0.51, 0.98, -1.97)},
        working="0.5 + 0.01, 1.0 - 0.02, -2.0 + 0.03",
    )

    def parameters(self, vehicle: Vehicle) -> tuple[Parameter, ...]:
        """b_x, b_y, b_z [rad/s]; scope flight."""
        return vector_parameters(
            "b_",
            "xyz",
            unit="rad/s",
            scale=0.01,
            meaning="gyro bias",
            scope="flight",
            possible=POSSIBLE,
        )

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """Added after misalignment and scale."""
        return {"gyro": flow.measured["gyro"] + ca.vertcat(p["b_x"], p["b_y"], p["b_z"])}
