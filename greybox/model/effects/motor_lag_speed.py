"""motor_lag_speed: rotors answer faster, the faster they turn."""

from __future__ import annotations

from collections.abc import Mapping

from greybox.model.effect import Effect, Flow, Needs, ReferenceCase
from greybox.model.parameter import Parameter
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr


class MotorLagSpeed(Effect):
    """d nu / dt = (nu_ss - nu) / tau (1 + s ((nu + nu_ss) / (2 nu_h) - 1)): tau is the time constant
    of motor_lag about the speed nu_h that hovers, s the share of its damping that grows with speed.

    A motor's torque pays for its own damping and for the drag of its propeller, J dnu/dt = b (nu_ss
    - nu) + k (nu_ss^2 - nu^2), which is the same with s = 2 k nu_h / (b + 2 k nu_h): none at s = 0,
    all by the propeller at s = 1.
    """

    name = "motor_lag_speed"
    stage = "rotor"
    summary = "rotors answer faster, the faster they turn (damped by the propeller's drag)"
    formula = "1/tau(nu) = (1 + s ((nu + nu_ss) / (2 nu_hover) - 1)) / tau"
    references = (
        "Bouabdallah, Murrieri and Siegwart 2004, Design and Control of an Indoor Micro Quadrotor, "
        "ICRA (rotor with quadratic drag, linearised about its speed)",
        "drone-models, documentation of first_principles: dOmega/dt = c1 (Omega_c - Omega) + c2 "
        "(Omega_c^2 - Omega^2); its nano quadrotors have s = 0 to 0.4 rising, 0.7 to 1 falling",
    )
    validity = (
        "next to motor_lag; never slower than a tenth of the rate in hover. A rate by nu alone, not "
        "by the mean with nu_ss, leaves a motor_lag_asymmetry below 0"
    )
    needs = Needs(effects=("motor_lag",))
    early = frozenset({"lag_speed"})
    case = ReferenceCase(
        parameters={"s": 0.4},
        flow={},
        expected={"lag_speed": 0.4},
        working="the share is the parameter itself",
    )

    def parameters(self, vehicle: Vehicle) -> tuple[Parameter, ...]:
        """The share s [-]; beyond 0 to 1 for motors whose controller does more than that."""
        return (
            Parameter(
                name="s",
                unit="-",
                nominal=0.0,
                lower=-1.0,
                upper=2.0,
                null=0.0,
                scale=0.3,
                meaning="share of the damping that grows with speed",
            ),
        )

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """The model knows it before the lag is used."""
        return {"lag_speed": p["s"]}
