"""pose_delay: pose and velocity come from another clock, or later, than the IMU and the commands."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from greybox.frames import quat_exp, quat_multiply
from greybox.model.effect import Effect, Flow, Needs, ReferenceCase
from greybox.model.parameter import Parameter
from greybox.symbolic import Expr


class PoseDelay(Effect):
    """Position, velocity and attitude as they were d seconds earlier, by back-extrapolation from the present state.

    A negative d means that the IMU and the commands are the later ones: logs whose clocks drift against each other need
    both signs. sensor_delay cannot replace them, since there the commands stay with the pose.
    """

    name = "pose_delay"
    stage = "sensor"
    summary = "pose and velocity are seen later than the IMU"
    formula = "p_meas = p - d v, v_meas = v - d dv/dt, q_meas = q * exp(-d omega / 2)"
    references = ("Li and Mourikis 2014, Online temporal calibration for camera-IMU systems, IJRR 33(7)",)
    validity = "delays over which velocity and body rate hardly change: a few tens of milliseconds"
    needs = Needs(sensors=("position", "attitude", "velocity"))
    order = 5
    case = ReferenceCase(
        parameters={"d": 0.02},
        flow={
            "measured": (1.0, 0.0, 0.0, 0.0), "omega": (0.0, 0.0, 157.07963267948966),
            "velocity_world": (1.0, 2.0, 3.0), "acceleration_world": (0.0, 0.0, 0.0),
        },
        expected={"attitude": (0.0, 0.0, 0.0, -1.0)},
        working="157.08 rad/s x 0.02 s = pi: half a turn back about z, the half angle is -90 deg",
    )  # fmt: skip

    def parameters(self, vehicle: Any) -> tuple[Parameter, ...]:
        """d [s]."""
        return (
            Parameter(
                name="d",
                unit="s",
                nominal=0.0,
                lower=-0.1,
                upper=0.1,
                null=0.0,
                scale=0.01,
                meaning="delay of the pose",
            ),
        )

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """Extrapolate the readings back by d."""
        d = p["d"]
        out: dict[str, Expr] = {}
        if "attitude" in flow.measured:
            out["attitude"] = quat_multiply(flow.measured["attitude"], quat_exp(-d * flow.omega))
        if "position" in flow.measured:
            out["position"] = flow.measured["position"] - d * flow.velocity_world
        if "velocity" in flow.measured:
            out["velocity"] = flow.measured["velocity"] - d * flow.acceleration_world
        return out
