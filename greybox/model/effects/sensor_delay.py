"""sensor_delay: gyro and accelerometer are seen later than the pose."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from greybox.model.effect import Effect, Flow, Needs, ReferenceCase
from greybox.model.parameter import Parameter
from greybox.symbolic import Expr


class SensorDelay(Effect):
    """Gyro and accelerometer report the instant t - d; pose, velocity and commands are those of t.

    The model goes back from x(t) by one straight step, x(t - d) = x - d dx/dt, and lets both sensors read there: the
    gyro shows omega - d domega/dt with the mean of the commands since then, the accelerometer the specific force of the
    earlier state, with the rotor speeds of the command in force d earlier. Errors are of second order: d^2/2 times the
    second derivative of the state.

    It is not pose_delay with the other sign: there commands stay with the IMU, here they stay with the pose. A delay
    common to IMU and pose is command_delay.
    """

    name = "sensor_delay"
    stage = "sensor"
    summary = "gyro and accelerometer are seen later than pose and commands"
    formula = "y_imu(t) = h_imu(x(t - d)), x(t - d) = x - d dx/dt"
    references = ("Li and Mourikis 2014, Online temporal calibration for camera-IMU systems, IJRR 33(7)",)
    validity = "delays over which rotor speed and body rate run nearly straight: up to about half of a motor lag"
    needs = Needs(sensors=("gyro", "accelerometer"), other_sensors=("position", "attitude", "velocity"))
    order = 50
    early = frozenset({"imu_delay"})
    case = ReferenceCase(
        parameters={"d": 0.008}, flow={}, expected={"imu_delay": 0.008}, working="the delay is the parameter itself"
    )

    def parameters(self, vehicle: Any) -> tuple[Parameter, ...]:
        """The delay d [s]."""
        return (
            Parameter(
                name="d", unit="s", nominal=0.0, lower=0.0, upper=0.05, null=0.0, scale=0.01, meaning="delay of the IMU"
            ),
        )

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """Last in the chain: constant mounting, scale and bias are the same at t - d."""
        return {"imu_delay": p["d"]}
