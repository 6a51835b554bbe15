"""mocap_misalignment: the marker frame of the motion capture is turned against the body axes."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca

from greybox.frames import quat_exp, quat_multiply
from greybox.model.effect import Effect, Flow, Needs, ReferenceCase, vector_parameters
from greybox.model.parameter import Parameter
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr

POSSIBLE = 0.175
"""Largest angle [rad] that is a mounting error: ten degrees. More is another choice of axes."""


class MocapMisalignment(Effect):
    """q_meas = q * exp(theta / 2): the measured attitude is that of the marker frame."""

    name = "mocap_misalignment"
    stage = "sensor"
    summary = "angle between the measured attitude and the body"
    formula = "q_meas = q * exp(theta / 2), v_marker = Exp(theta)^T v_body"
    references = (
        "Furrer, Fehr, Novkovic et al. 2018, Evaluation of Combined Time-Offset Estimation and "
        "Hand-Eye Calibration on Robotic Datasets, Field and Service Robotics",
    )
    validity = "angles up to a few tenths of a radian"
    needs = Needs(sensors=("attitude",))
    order = 20
    case = ReferenceCase(
        parameters={"theta_x": 1.5707963267948966, "theta_y": 0.0, "theta_z": 0.0},
        flow={"measured": (1.0, 0.0, 0.0, 0.0)},
        expected={"attitude": (0.7071067811865476, 0.7071067811865476, 0.0, 0.0)},
        working="a level body whose markers are rolled by 90 deg: half angle 45 deg",
    )

    def parameters(self, vehicle: Vehicle) -> tuple[Parameter, ...]:
        """theta_x, theta_y, theta_z [rad]."""
        return vector_parameters(
            "theta_",
            "xyz",
            unit="rad",
            scale=0.02,
            meaning="marker frame angle",
            lower=-1.6,
            upper=1.6,
            possible=POSSIBLE,
        )

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """Turn the measured attitude."""
        turn = quat_exp(ca.vertcat(p["theta_x"], p["theta_y"], p["theta_z"]))
        return {"attitude": quat_multiply(flow.measured["attitude"], turn)}
