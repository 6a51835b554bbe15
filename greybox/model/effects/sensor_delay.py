"""sensor_delay: gyro and accelerometer are seen later than the pose."""

from __future__ import annotations

from collections.abc import Mapping

from greybox.model.effect import Effect, Flow, Needs, ReferenceCase, delay_parameters
from greybox.model.parameter import Parameter
from greybox.model.sensors import on_clock
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr


class SensorDelay(Effect):
    """Gyro and accelerometer report the instant t - d; pose, velocity and commands are those of t.

    The states of a model with this effect are those of the instant that gyro and accelerometer
    show: commands reach them d later, the pose is d ahead of them, by the midpoint rule with the
    mean command in between, and so are measured rotor speeds. The fast sensors are then exact
    however long d is, and force and torque noise of the last d, which they have not seen, counts
    nowhere. Errors of the pose are those of pose_delay.

    It is not pose_delay with the other sign: there commands stay with the IMU, here they stay with
    the pose. A delay common to IMU and pose is command_delay, to the last digit.
    """

    name = "sensor_delay"
    stage = "sensor"
    summary = "gyro and accelerometer are seen later than pose and commands"
    formula = "y_imu(t) = h_imu(x(t - d)), y_pose(t) = h_pose(x(t)), u(t)"
    references = (
        "Li and Mourikis 2014, Online temporal calibration for camera-IMU systems, IJRR 33(7)",
    )
    validity = "delays over which rotor speed runs nearly straight: a few tens of milliseconds"
    needs = Needs(sensors=on_clock("imu"), other_sensors=("position", "attitude", "velocity"))
    order = 50
    early = frozenset({"imu_delay"})
    case = ReferenceCase(
        parameters={"d": 0.008},
        flow={},
        expected={"imu_delay": 0.008},
        working="the delay is the parameter itself",
    )

    def parameters(self, vehicle: Vehicle) -> tuple[Parameter, ...]:
        """The delay d [s]."""
        return delay_parameters("delay of the IMU", 0.0, 0.05)

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """Last in the chain: constant mounting, scale and bias are the same at t - d."""
        return {"imu_delay": p["d"]}
