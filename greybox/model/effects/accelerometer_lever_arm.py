"""accelerometer_lever_arm: the accelerometer sits elsewhere than the vehicle file says."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca

from greybox.model.effect import Effect, Flow, Needs, ReferenceCase, vector_parameters
from greybox.model.parameter import Parameter
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr


class AccelerometerLeverArm(Effect):
    """a_meas = a + domega/dt x r + omega x (omega x r), r added to the IMU position of the vehicle
    file."""

    name = "accelerometer_lever_arm"
    stage = "sensor"
    summary = "the accelerometer lies r away from its stated place"
    formula = "a_meas = a + domega x r + omega x (omega x r)"
    references = (
        "Titterton and Weston 2004, Strapdown Inertial Navigation Technology, 2nd edition (size "
        "effect)",
    )
    validity = "rigid mounting; all three axes measured at one point"
    tags = frozenset({"linear-in-parameters"})
    needs = Needs(sensors=("accelerometer",))
    order = 10
    case = ReferenceCase(
        parameters={"r_x": 0.01, "r_y": 0.0, "r_z": 0.02},
        flow={
            "measured": (1.0, 2.0, 3.0),
            "omega": (0.0, 0.0, 10.0),
            "angular_acceleration": (0.0, 50.0, 0.0),
        },
        expected={"accelerometer": (1.0, 2.0, 2.5)},
        working="spin-up (0, 50, 0) x r = (1, 0, -0.5); centripetal -10^2 (0.01, 0, 0) = (-1, 0, "
        "0)",
    )

    def parameters(self, vehicle: Vehicle) -> tuple[Parameter, ...]:
        """r_x, r_y, r_z [m], body axes."""
        limit = vehicle.arm_length
        return vector_parameters(
            "r_", "xyz", unit="m", scale=0.1 * limit, meaning="lever arm", lower=-limit, upper=limit
        )

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """First in the chain: it is an acceleration in body axes."""
        r: Expr = ca.vertcat(p["r_x"], p["r_y"], p["r_z"])
        spin_up = ca.cross(flow.angular_acceleration, r)
        return {
            "accelerometer": flow.measured["accelerometer"]
            + spin_up
            + ca.cross(flow.omega, ca.cross(flow.omega, r))
        }
