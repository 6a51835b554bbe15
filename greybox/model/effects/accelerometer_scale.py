"""accelerometer_scale: each axis of the accelerometer reads a little too much or too little."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca

from greybox.model.effect import Effect, Flow, Needs, ReferenceCase, vector_parameters
from greybox.model.parameter import Parameter
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr

POSSIBLE = 0.25
"""Largest scale error that a calibrated sensor has: more is another unit or range setting."""


class AccelerometerScale(Effect):
    """a_meas = (I + diag(s)) a. It acts on the prediction; the data stay as they were measured."""

    name = "accelerometer_scale"
    stage = "sensor"
    summary = "scale error of each axis of the accelerometer"
    formula = "a_meas = (I + diag(s_x, s_y, s_z)) a"
    references = (
        "Tedaldi, Pretto and Menegatti 2014, A Robust and Easy to Implement Method for IMU "
        "Calibration without External Equipments, ICRA",
    )
    validity = "constant over a flight, the same for both signs"
    tags = frozenset({"linear-in-parameters"})
    needs = Needs(sensors=("accelerometer",))
    order = 30
    case = ReferenceCase(
        parameters={"s_x": 0.01, "s_y": -0.02, "s_z": 0.5},
        flow={"measured": (0.5, 1.0, -2.0)},
        expected={"accelerometer": (0.505, 0.98, -3.0)},
        working="1.01 * 0.5, 0.98 * 1.0, 1.5 * (-2.0)",
    )

    def parameters(self, vehicle: Vehicle) -> tuple[Parameter, ...]:
        """s_x, s_y, s_z [-]."""
        return vector_parameters(
            "s_",
            "xyz",
            unit="-",
            scale=0.02,
            meaning="scale error",
            lower=-0.5,
            upper=0.5,
            possible=POSSIBLE,
        )

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """After misalignment, before bias."""
        scale: Expr = ca.vertcat(p["s_x"], p["s_y"], p["s_z"])
        return {"accelerometer": (1 + scale) * flow.measured["accelerometer"]}
