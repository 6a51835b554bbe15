"""rotor_drag: horizontal force on every rotor disc, proportional to rotor speed and airspeed."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca

from greybox.model.effect import Effect, Flow, ReferenceCase, vector_parameters
from greybox.model.flow import unit_per_speed
from greybox.model.parameter import Parameter
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr


class RotorDrag(Effect):
    """F_i = -Omega_i diag(k_x, k_y, 0) v_a,i at hub i; its moment r_i x F_i comes along (axial
    part: axial_inflow)."""

    name = "rotor_drag"
    stage = "wrench"
    summary = "induced drag of the rotors (H-force)"
    formula = "F_i = -Omega_i diag(k_x, k_y, 0) v_a,i at hub i"
    references = (
        "Martin and Salaun 2010, The true role of accelerometer feedback in quadrotor control, "
        "ICRA",
        "Faessler, Franchi and Scaramuzza 2018, Differential flatness of quadrotor dynamics "
        "subject to rotor drag for "
        "accurate tracking of high-speed trajectories, IEEE Robotics and Automation Letters 3(2)",
        "Kai, Allibert, Hua and Hamel 2017, Nonlinear feedback control of quadrotors, "
        "IFAC-PapersOnLine 50(1)",
    )
    validity = "airspeed well below the blade tip speed"
    tags = frozenset({"dissipative", "zero-at-rest", "linear-in-parameters"})
    case = ReferenceCase(
        parameters={"k_x": 2e-6, "k_y": 1e-6},
        flow={
            "rotor_speed": (1000.0, 1000.0, 2000.0, 2000.0),
            "velocity": (3.0, -1.0, 0.5),
            "omega": (0.0, 0.0, 0.0),
        },
        expected={
            "hub_force": (
                (-6e-3, -6e-3, -12e-3, -12e-3),
                (1e-3, 1e-3, 2e-3, 2e-3),
                (0.0, 0.0, 0.0, 0.0),
            )
        },
        working="-1000 * 2e-6 * 3 = -6e-3 N along x; -1000 * 1e-6 * (-1) = 1e-3 N along y; twice "
        "that at 2000 rad/s",
    )

    def parameters(self, vehicle: Vehicle) -> tuple[Parameter, ...]:
        """k_x, k_y [kg/rad]; without speed_max at nu = 1 [N s/m]."""
        scale = 0.05 * vehicle.mass.value / vehicle.omega_scale
        return vector_parameters(
            "k_",
            "xy",
            unit=unit_per_speed(vehicle, "kg/rad", "N s/m"),
            scale=scale,
            meaning="rotor drag coefficient",
            lower=0.0,
        )

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """Force at every hub."""
        gain = ca.vertcat(p["k_x"], p["k_y"], 0)
        n = len(flow.vehicle.rotors)
        return {
            "hub_force": ca.horzcat(
                *(-flow.rotor_speed[i] * gain * flow.airspeed(i) for i in range(n))
            )
        }
