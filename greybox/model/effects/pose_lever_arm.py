"""pose_lever_arm: the point whose position is tracked is not the body origin."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca

from greybox.model.effect import Effect, Flow, Needs, ReferenceCase, vector_parameters
from greybox.model.parameter import Parameter
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr


class PoseLeverArm(Effect):
    """Position and velocity are those of a point r away from the body origin, as the pivot that
    motion capture gives to a set of markers. Without it a centre of mass that moves the body origin
    would explain them, with a torque that is not there."""

    name = "pose_lever_arm"
    stage = "sensor"
    summary = "the tracked point lies r away from the body origin"
    formula = "p_meas = p + R r, v_meas = v + R (omega x r)"
    references = (
        "Furrer, Fehr, Novkovic et al. 2018, Evaluation of Combined Time-Offset Estimation and "
        "Hand-Eye Calibration on Robotic Datasets, Field and Service Robotics",
    )
    validity = "markers that do not move against the body"
    tags = frozenset({"linear-in-parameters"})
    needs = Needs(sensors=("position", "velocity"))
    order = 10
    case = ReferenceCase(
        parameters={"r_x": 0.01, "r_y": 0.0, "r_z": 0.02},
        flow={
            "measured": (1.0, 2.0, 3.0),
            "omega": (0.0, 5.0, 0.0),
            "rotation": ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
        },
        expected={"position": (1.0, 2.01, 3.02), "velocity": (1.0, 2.1, 2.95)},
        working="yawed by 90 deg: R r = (0, 0.01, 0.02); omega x r = 5 (0.02, 0, -0.01), turned "
        "(0, 0.1, -0.05)",
    )

    def parameters(self, vehicle: Vehicle) -> tuple[Parameter, ...]:
        """r_x, r_y, r_z [m], body axes."""
        limit = 2 * vehicle.arm_length
        return vector_parameters(
            "r_",
            "xyz",
            unit="m",
            scale=0.1 * vehicle.arm_length,
            meaning="tracked point from the body origin",
            lower=-limit,
            upper=limit,
        )

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """The readings of those of the two sensors that are there."""
        r: Expr = ca.vertcat(p["r_x"], p["r_y"], p["r_z"])
        shift = {
            "position": flow.rotation @ r,
            "velocity": flow.rotation @ ca.cross(flow.omega, r),
        }
        return {n: flow.measured[n] + v for n, v in shift.items() if n in flow.measured}
