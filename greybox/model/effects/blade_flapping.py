"""blade_flapping: the rotor discs tilt back in forward flight and pitch the body up."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca

from greybox.model.effect import Effect, Flow, ReferenceCase
from greybox.model.flow import unit_per_speed
from greybox.model.parameter import Parameter
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr


class BladeFlapping(Effect):
    """tau = sum_i k_flap Omega_i (v_a,i x e_z): positive k_flap is nose up in forward flight.
    Unbounded in sign."""

    name = "blade_flapping"
    stage = "wrench"
    summary = "moment proportional to airspeed"
    formula = "tau = sum_i k_flap Omega_i (v_a,i x e_z)"
    references = (
        "Bangura and Mahony 2012, Nonlinear dynamic modeling for high performance control of a "
        "quadrotor, ACRA",
        "Folk, Paulos and Kumar 2023, RotorPy: a Python-based multirotor simulator with "
        "aerodynamics (opposite sign)",
    )
    validity = (
        "airspeed well below the blade tip speed; not separable from a vertical "
        "centre-of-mass offset with drag"
    )
    tags = frozenset({"zero-at-rest", "linear-in-parameters"})
    case = ReferenceCase(
        parameters={"k_flap": 1e-7},
        flow={
            "rotor_speed": (1000.0, 1000.0, 1500.0, 1500.0),
            "velocity": (2.0, 1.0, 0.3),
            "omega": (0.0, 0.0, 0.0),
        },
        expected={"moment": (5e-4, -1e-3, 0.0)},
        working="sum Omega = 5000; v x e_z = (v_y, -v_x, 0) = (1, -2, 0); 1e-7 * 5000 * (1, -2, 0)",
    )

    def parameters(self, vehicle: Vehicle) -> tuple[Parameter, ...]:
        """k_flap [kg m/rad]; without speed_max at nu = 1 [N s]."""
        scale = 0.05 * vehicle.mass.value * vehicle.arm_length / vehicle.omega_scale
        return (
            Parameter(
                name="k_flap",
                unit=unit_per_speed(vehicle, "kg m/rad", "N s"),
                nominal=0.0,
                null=0.0,
                scale=scale,
                meaning="flapping moment",
            ),
        )

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """Sum over the rotors."""
        n = len(flow.vehicle.rotors)
        total = sum((flow.rotor_speed[i] * flow.airspeed(i) for i in range(n)), ca.DM.zeros(3))
        return {"moment": p["k_flap"] * ca.vertcat(total[1], -total[0], 0)}
