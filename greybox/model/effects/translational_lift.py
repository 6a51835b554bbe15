"""translational_lift: a rotor that moves edgewise through the air gains thrust."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca

from greybox.model.effect import Effect, Flow, ReferenceCase
from greybox.model.parameter import Parameter
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr


class TranslationalLift(Effect):
    """dT_i = k_h (v_a,i,x^2 + v_a,i,y^2): less induced velocity in forward flight, to second order
    in the airspeed."""

    name = "translational_lift"
    stage = "thrust"
    summary = "thrust grows with the airspeed in the plane of the rotor"
    formula = "dT_i = k_h (v_a,i,x^2 + v_a,i,y^2)"
    references = (
        "Hoffmann, Huang, Waslander and Tomlin 2007, Quadrotor Helicopter Flight Dynamics and "
        "Control: Theory and Experiment, AIAA Guidance, Navigation and Control Conference",
        "Folk, Paulos and Kumar 2023, RotorPy: a Python-based multirotor simulator with "
        "aerodynamics, arXiv:2306.04485",
    )
    validity = (
        "airspeed up to about the induced velocity of hover; faster, the gain grows less "
        "than quadratically"
    )
    tags = frozenset({"linear-in-parameters"})
    case = ReferenceCase(
        parameters={"k_h": 1e-3},
        flow={"velocity": (3.0, -4.0, 2.0), "omega": (0.0, 0.0, 0.0)},
        expected={"thrust_increment": (0.025, 0.025, 0.025, 0.025)},
        working="3^2 + 4^2 = 25 m^2/s^2, times 1e-3; the axial 2 m/s do nothing",
    )

    def parameters(self, vehicle: Vehicle) -> tuple[Parameter, ...]:
        """k_h [N s^2/m^2]."""
        scale = 1e-3 * vehicle.mass.value / vehicle.arm_length
        return (
            Parameter(
                name="k_h",
                unit="N s^2/m^2",
                nominal=0.0,
                lower=0.0,
                null=0.0,
                scale=scale,
                meaning="lift coefficient",
            ),
        )

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """Thrust gained by every rotor."""
        n = len(flow.vehicle.rotors)
        return {
            "thrust_increment": p["k_h"]
            * ca.vertcat(*(ca.sumsqr(flow.airspeed(i)[:2]) for i in range(n)))
        }
