"""constant_force: a steady world-frame force."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca

from greybox.model.effect import Effect, Flow, ReferenceCase, vector_parameters
from greybox.model.parameter import Parameter
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr


class ConstantForce(Effect):
    """F_world = f, constant during a flight (a wind on an unmodelled drag looks so at low
    speed)."""

    name = "constant_force"
    stage = "wrench"
    summary = "steady force fixed in the world"
    formula = "F = R^T f"
    references = (
        "Maeder, Borrelli and Morari 2009, Linear offset-free Model Predictive Control, Automatica "
        "45(10)",
    )
    validity = "constant over a flight"
    tags = frozenset({"linear-in-parameters"})
    case = ReferenceCase(
        parameters={"f_x": 0.01, "f_y": 0.0, "f_z": 0.02},
        flow={"rotation": ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))},
        expected={"force": (0.0, -0.01, 0.02)},
        working="yaw 90 deg: body x points along world y, body y along -world x, so world +x is "
        "body -y",
    )

    def parameters(self, vehicle: Vehicle) -> tuple[Parameter, ...]:
        """f_x, f_y, f_z [N] world; scope flight."""
        weight = vehicle.mass.value * vehicle.gravity
        return vector_parameters(
            "f_",
            "xyz",
            unit="N",
            scale=0.02 * weight,
            meaning="constant world force",
            scope="flight",
        )

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """World force in body axes."""
        return {"force": flow.rotation.T @ ca.vertcat(p["f_x"], p["f_y"], p["f_z"])}
