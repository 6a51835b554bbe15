"""imu_misalignment: the IMU is mounted turned against the body axes."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca

from greybox.frames import quat_exp, rotation_matrix
from greybox.model.effect import Effect, Flow, Needs, ReferenceCase, vector_parameters
from greybox.model.parameter import Parameter
from greybox.model.sensors import on_clock
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr

POSSIBLE = 0.175
"""Largest angle [rad] that is a mounting error: ten degrees. More is another choice of axes."""


class ImuMisalignment(Effect):
    """v_imu = Exp(theta)^T v_body for gyro and accelerometer."""

    name = "imu_misalignment"
    stage = "sensor"
    summary = "mounting angle of the IMU"
    formula = "v_imu = Exp(theta)^T v_body"
    references = (
        "Woodman 2007, An introduction to inertial navigation, Cambridge UCAM-CL-TR-696, sec. 3-4",
    )
    validity = "angles up to a few tenths of a radian"
    needs = Needs(sensors=on_clock("imu"))
    order = 20
    case = ReferenceCase(
        parameters={"theta_x": 0.0, "theta_y": 0.0, "theta_z": 1.5707963267948966},
        flow={"measured": (1.0, 2.0, 3.0)},
        expected={"gyro": (2.0, -1.0, 3.0), "accelerometer": (2.0, -1.0, 3.0)},
        working="an IMU turned 90 deg to the left sees body y as its x and body -x as its y",
    )

    def parameters(self, vehicle: Vehicle) -> tuple[Parameter, ...]:
        """theta_x, theta_y, theta_z [rad]."""
        return vector_parameters(
            "theta_",
            "xyz",
            unit="rad",
            scale=0.02,
            meaning="mounting angle",
            lower=-1.6,
            upper=1.6,
            possible=POSSIBLE,
        )

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """The same turn for both sensors."""
        turn = rotation_matrix(quat_exp(ca.vertcat(p["theta_x"], p["theta_y"], p["theta_z"]))).T
        return {
            name: turn @ value for name, value in flow.measured.items() if name in on_clock("imu")
        }
