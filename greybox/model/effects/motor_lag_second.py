"""motor_lag_second: rotors answer with second order."""

from __future__ import annotations

from collections.abc import Mapping

from greybox.model.effect import Effect, Flow, Needs, ReferenceCase
from greybox.model.parameter import Parameter
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr


class MotorLagSecond(Effect):
    """b tau^2 nu'' + tau nu' + nu = nu_ss, tau the time constant of motor_lag: its frequency is 1 /
    (tau sqrt(b)) [rad/s], its damping 1 / (2 sqrt(b)).

    Up to b = 1/4 two lags one after the other, as those of a filter of the command and of a motor:
    their sum is tau, their product b tau^2. Beyond it rotors overshoot. Solved exactly, so that b =
    0 is motor_lag, with the true slope there.
    """

    name = "motor_lag_second"
    stage = "rotor"
    summary = (
        "second order of the rotors' lag (a filter of the command, a governor that overshoots)"
    )
    formula = "b tau^2 nu'' + tau nu' + nu = nu_ss"
    references = (
        "Ogata 2010, Modern Control Engineering, 5th ed., sec. 5-3 (second-order systems)",
        "Franchi and Mallet 2017, Adaptive closed-loop speed control of BLDC motors with "
        "applications to multi-rotor aerial vehicles, ICRA",
    )
    validity = (
        "next to motor_lag; no part of a command passes at once, as a governor's proportional part "
        "does. Where the lag differs between up and down, or with speed, as at the start of a step"
    )
    needs = Needs(effects=("motor_lag",))
    early = frozenset({"lag_second"})
    case = ReferenceCase(
        parameters={"b": 0.5},
        flow={},
        expected={"lag_second": 0.5},
        working="the coefficient is the parameter itself",
    )

    def parameters(self, vehicle: Vehicle) -> tuple[Parameter, ...]:
        """The coefficient b [-]; 4 is a damping of 0.25."""
        return (
            Parameter(
                name="b",
                unit="-",
                nominal=0.0,
                lower=0.0,
                upper=4.0,
                null=0.0,
                scale=0.3,
                meaning="coefficient of the second derivative, in tau^2",
            ),
        )

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """The model knows it before the lag is used."""
        return {"lag_second": p["b"]}
