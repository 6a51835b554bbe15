"""pose_delay: pose and velocity come from another clock, or later, than the IMU and the
commands."""

from __future__ import annotations

from collections.abc import Mapping

from greybox.model.effect import Effect, Flow, Needs, ReferenceCase, delay_parameters
from greybox.model.parameter import Parameter
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr


class PoseDelay(Effect):
    """Position, velocity and attitude are those of t - d; IMU and commands are those of t.

    The model goes back from x(t) by the midpoint rule with the commands since then (their mean for
    velocity and rates, their mean weighted by the way that remains for position and attitude) and
    rotors that follow the mean with their lag: errors are of third order in d. A negative d means
    that the IMU and the commands are the later ones: logs whose clocks drift against each other
    need both signs (the command is then taken as held, and the noise of the coming step as acting
    already). sensor_delay cannot replace them, since there the commands stay with the pose.
    """

    name = "pose_delay"
    stage = "sensor"
    summary = "pose and velocity are seen later than the IMU"
    formula = "y_pose(t) = h_pose(x(t - d)), x(t - d) = x - d dx/dt(t - d/2)"
    references = (
        "Li and Mourikis 2014, Online temporal calibration for camera-IMU systems, IJRR 33(7)",
    )
    validity = "delays over which rotor speed runs nearly straight: a few tens of milliseconds"
    needs = Needs(sensors=("position", "attitude", "velocity"))
    order = 5
    early = frozenset({"pose_delay"})
    case = ReferenceCase(
        parameters={"d": 0.012},
        flow={},
        expected={"pose_delay": 0.012},
        working="the delay is the parameter itself",
    )

    def parameters(self, vehicle: Vehicle) -> tuple[Parameter, ...]:
        """d [s]."""
        return delay_parameters("delay of the pose", -0.1, 0.1)

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """Constant mounting and scale are the same at t - d."""
        return {"pose_delay": p["d"]}
