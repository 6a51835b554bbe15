"""rotational_damping: a moment against the body rate."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca

from greybox.model.effect import Effect, Flow, ReferenceCase, vector_parameters
from greybox.model.parameter import Parameter
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr


class RotationalDamping(Effect):
    """tau = -diag(d_p, d_q, d_r) omega."""

    name = "rotational_damping"
    stage = "wrench"
    summary = "moment against the body rate"
    formula = "tau = -diag(d_p, d_q, d_r) omega"
    references = (
        "Stevens, Lewis and Johnson 2015, Aircraft Control and Simulation, ch. 2 (damping "
        "derivatives)",
    )
    validity = "small rates; rotor inflow and hub drag lumped into one linear term"
    tags = frozenset({"dissipative", "zero-at-rest", "linear-in-parameters"})
    case = ReferenceCase(
        parameters={"d_p": 1e-4, "d_q": 2e-4, "d_r": 0.5e-4},
        flow={"omega": (2.0, -1.0, 4.0)},
        expected={"moment": (-2e-4, 2e-4, -2e-4)},
        working="-(1e-4 * 2, 2e-4 * (-1), 0.5e-4 * 4)",
    )

    def parameters(self, vehicle: Vehicle) -> tuple[Parameter, ...]:
        """d_p, d_q, d_r [N m s]."""
        scale = vehicle.inertia[0][0]  # 1 rad/s decays at 1 1/s
        return vector_parameters(
            "d_", "pqr", unit="N m s", scale=scale, meaning="damping", lower=0.0
        )

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """One coefficient per axis."""
        gain: Expr = ca.vertcat(p["d_p"], p["d_q"], p["d_r"])
        return {"moment": -gain * flow.omega}
