"""accelerometer_bias: a constant offset of the accelerometer."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca

from greybox.model.effect import Effect, Flow, Needs, ReferenceCase, vector_parameters
from greybox.model.parameter import Parameter
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr

POSSIBLE = 2.5
"""Largest offset that a sensor has [m/s^2]: 250 mg, the widest zero-g offset of a data sheet
(ADXL345, z). More is thrust, weight, another axis or another unit."""


class AccelerometerBias(Effect):
    """a_meas = a + b, constant during a flight."""

    name = "accelerometer_bias"
    stage = "sensor"
    summary = "constant offset of the accelerometer"
    formula = "a_meas = a + b"
    references = (
        "Woodman 2007, An introduction to inertial navigation, Cambridge UCAM-CL-TR-696, sec. 3-4",
    )
    validity = "constant over a flight"
    tags = frozenset({"linear-in-parameters"})
    needs = Needs(sensors=("accelerometer",))
    order = 40
    case = ReferenceCase(
        parameters={"b_x": 0.01, "b_y": -0.02, "b_z": 0.03},
        flow={"measured": (0.5, 1.0, -2.0)},
        expected={"accelerometer": (0.51, 0.98, -1.97)},
        working="0.5 + 0.01, 1.0 - 0.02, -2.0 + 0.03",
    )

    def parameters(self, vehicle: Vehicle) -> tuple[Parameter, ...]:
        """b_x, b_y, b_z [m/s^2]; scope flight."""
        return vector_parameters(
            "b_",
            "xyz",
            unit="m/s^2",
            scale=0.1,
            meaning="accelerometer bias",
            scope="flight",
            possible=POSSIBLE,
        )

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """Added after misalignment and scale."""
        return {
            "accelerometer": flow.measured["accelerometer"]
            + ca.vertcat(p["b_x"], p["b_y"], p["b_z"])
        }
