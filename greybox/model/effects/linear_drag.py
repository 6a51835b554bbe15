"""linear_drag: drag of the body, proportional to airspeed."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca

from greybox.model.effect import Effect, Flow, ReferenceCase, vector_parameters
from greybox.model.parameter import Parameter
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr


class LinearDrag(Effect):
    """F_j = -d_j v_a,j with v_a = R^T (v - w) of the centre of mass, through the centre of mass,
    whatever the rotors do."""

    name = "linear_drag"
    stage = "wrench"
    summary = "drag of the body, proportional to airspeed"
    formula = "F_j = -d_j v_a,j"
    references = (
        "Faessler, Franchi and Scaramuzza 2018, Differential flatness of quadrotor dynamics "
        "subject to rotor drag for accurate tracking of high-speed trajectories, IEEE Robotics and "
        "Automation Letters 3(2), eq. 2",
    )
    validity = "rotor speeds near hover: a drag of the rotors grows with their speed (rotor_drag)"
    tags = frozenset({"dissipative", "zero-at-rest", "linear-in-parameters"})
    case = ReferenceCase(
        parameters={"d_x": 0.1, "d_y": 0.2, "d_z": 0.3},
        flow={"velocity": (3.0, 3.0, 2.0), "wind": (1.0, 5.0, 1.0)},
        expected={"force": (-0.2, 0.4, -0.3)},
        working="v_a = (2, -2, 1): -0.1 * 2, -0.2 * (-2), -0.3 * 1",
    )

    def parameters(self, vehicle: Vehicle) -> tuple[Parameter, ...]:
        """d_x, d_y, d_z [N s/m]."""
        scale = 0.1 * vehicle.mass.value
        return vector_parameters(
            "d_", "xyz", unit="N s/m", scale=scale, meaning="linear drag coefficient", lower=0.0
        )

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """Force through the centre of mass."""
        gain: Expr = ca.vertcat(p["d_x"], p["d_y"], p["d_z"])
        return {"force": -gain * (flow.velocity - flow.wind)}
