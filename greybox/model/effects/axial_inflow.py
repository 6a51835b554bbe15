"""axial_inflow: a rotor that climbs loses thrust."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca

from greybox.model.effect import Effect, Flow, ReferenceCase
from greybox.model.flow import unit_per_speed
from greybox.model.parameter import Parameter
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr


class AxialInflow(Effect):
    """dT_i = -k_z Omega_i v_a,i,z: momentum theory, linear in the airspeed along the rotor axis."""

    name = "axial_inflow"
    stage = "thrust"
    summary = "thrust falls with the airspeed along the rotor axis"
    formula = "dT_i = -k_z Omega_i v_a,i,z"
    references = (
        "Huang, Hoffmann, Waslander and Tomlin 2009, Aerodynamics and control of autonomous "
        "quadrotor helicopters in aggressive maneuvering, ICRA",
        "Folk, Paulos and Kumar 2023, RotorPy: a Python-based multirotor simulator with "
        "aerodynamics, arXiv:2306.04485",
    )
    validity = "axial airspeed well below the induced velocity; not in fast descent (vortex ring)"
    tags = frozenset({"dissipative", "zero-at-rest", "linear-in-parameters"})
    case = ReferenceCase(
        parameters={"k_z": 2e-4},
        flow={
            "rotor_speed": (500.0, 500.0, 1000.0, 1000.0),
            "velocity": (3.0, 1.0, 2.0),
            "omega": (0.0, 0.0, 0.0),
        },
        expected={"thrust_increment": (-0.2, -0.2, -0.4, -0.4)},
        working="-2e-4 kg/rad * 500 rad/s * 2 m/s = -0.2 N, twice that at 1000 rad/s; sideways "
        "motion does nothing",
    )

    def parameters(self, vehicle: Vehicle) -> tuple[Parameter, ...]:
        """k_z [kg/rad]; 2.3e-4 is RotorPy's for a craft of 0.5 kg. Without speed_max at nu = 1
        [N s/m]."""
        scale = 0.1 * vehicle.mass.value / vehicle.omega_scale
        return (
            Parameter(
                name="k_z",
                unit=unit_per_speed(vehicle, "kg/rad", "N s/m"),
                nominal=0.0,
                lower=0.0,
                null=0.0,
                scale=scale,
                meaning="inflow coefficient",
            ),
        )

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """Thrust lost by every rotor."""
        n = len(flow.vehicle.rotors)
        axial = ca.vertcat(*(flow.airspeed(i)[2] for i in range(n)))
        return {"thrust_increment": -p["k_z"] * flow.rotor_speed * axial}
