"""parasitic_drag: the drag of the fuselage, quadratic in airspeed."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca

from greybox.model.effect import Effect, Flow, ReferenceCase, vector_parameters
from greybox.model.parameter import Parameter
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr, safe_norm


class ParasiticDrag(Effect):
    """F_j = -c_j v_a,j |v_a| with v_a = R^T (v - w) of the centre of mass, through the centre of
    mass."""

    name = "parasitic_drag"
    stage = "wrench"
    summary = "drag of the fuselage, quadratic in airspeed"
    formula = "F_j = -c_j v_a,j |v_a|"
    references = (
        "Folk, Paulos and Kumar 2023, RotorPy: a Python-based multirotor simulator with "
        "aerodynamics, arXiv:2306.04485",
    )
    validity = "bluff body: one coefficient per axis at all airspeeds"
    tags = frozenset({"dissipative", "zero-at-rest", "linear-in-parameters"})
    case = ReferenceCase(
        parameters={"c_x": 0.01, "c_y": 0.02, "c_z": 0.03},
        flow={"velocity": (3.0, 3.0, 2.0), "wind": (1.0, 5.0, 1.0)},
        expected={"force": (-0.06, 0.12, -0.09)},
        working="v_a = (2, -2, 1), |v_a| = 3: -0.01 * 2 * 3, -0.02 * (-2) * 3, -0.03 * 1 * 3",
    )

    def parameters(self, vehicle: Vehicle) -> tuple[Parameter, ...]:
        """c_x, c_y, c_z [N s^2/m^2]; half the density of air times drag coefficient and area."""
        scale = 2e-3 * vehicle.mass.value / vehicle.arm_length
        return vector_parameters(
            "c_", "xyz", unit="N s^2/m^2", scale=scale, meaning="drag coefficient", lower=0.0
        )

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """Force through the centre of mass."""
        gain: Expr = ca.vertcat(p["c_x"], p["c_y"], p["c_z"])
        airspeed = flow.velocity - flow.wind
        return {"force": -gain * airspeed * safe_norm(airspeed)}
