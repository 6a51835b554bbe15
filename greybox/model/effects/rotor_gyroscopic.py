"""rotor_gyroscopic: the angular momentum of the spinning rotors, turned by the body and changed by
the motors."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca

from greybox.model.effect import Effect, Flow, ReferenceCase
from greybox.model.flow import unit_per_speed
from greybox.model.parameter import Parameter
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr


class RotorGyroscopic(Effect):
    """tau = -omega x (J_r sum s_i Omega_i e_z) - J_r sum s_i dOmega_i/dt e_z.

    The first term does no work (omega . tau = 0). The second needs a rotor state (motor_lag):
    without one the rotors change speed in no time and the term is left out.
    """

    name = "rotor_gyroscopic"
    stage = "wrench"
    summary = "angular momentum of the rotors"
    formula = "tau = -omega x (J_r sum s_i Omega_i e_z) - J_r sum s_i dOmega_i/dt e_z"
    references = (
        "Bouabdallah 2007, Design and Control of Quadrotors with Application to Autonomous Flying, "
        "EPFL thesis",
    )
    validity = "rigid rotors with parallel axes"
    tags = frozenset({"linear-in-parameters", "rotor-acceleration"})
    case = ReferenceCase(
        parameters={"J_r": 1e-5},
        flow={
            "omega": (2.0, 3.0, 5.0),
            "rotor_speed": (100.0, 50.0, 100.0, 50.0),
            "nu_rate": (0.0, 0.0, 0.0, 0.0),
        },
        expected={"moment": (-3e-3, 2e-3, 0.0)},
        working="sum s Omega = 100 - 50 + 100 - 50 = 100, momentum 1e-3; -(2, 3, 5) x (0, 0, 1e-3) "
        "= (-3e-3, 2e-3, 0)",
    )

    def parameters(self, vehicle: Vehicle) -> tuple[Parameter, ...]:
        """J_r [kg m^2]: rotor and propeller about the spin axis; without speed_max its angular
        momentum at nu = 1 [kg m^2 rad/s]."""
        # Published rotors: 4.6e-3 of the craft's inertia about z (Bouabdallah 2007), 3.8e-3
        # (Luukkonen 2011); small propellers have less. They turn at some 1000 rad/s.
        known = vehicle.actuator.speed_max is not None
        scale = 2e-3 * float(vehicle.inertia[2][2]) * (1.0 if known else 1e3)
        return (
            Parameter(
                name="J_r",
                unit=unit_per_speed(vehicle, "kg m^2", "kg m^2 rad/s"),
                nominal=0.0,
                lower=0.0,
                null=0.0,
                scale=scale,
                meaning="inertia of one rotor"
                if known
                else "angular momentum of one at full speed",
            ),
        )

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """Both terms."""
        spin = ca.DM([r.spin for r in flow.vehicle.rotors])
        momentum = p["J_r"] * ca.dot(spin, flow.rotor_speed)
        change = p["J_r"] * flow.vehicle.omega_scale * ca.dot(spin, flow.nu_rate)
        turned = -ca.cross(flow.omega, ca.vertcat(0, 0, momentum))
        return {"moment": turned - ca.vertcat(0, 0, change)}
