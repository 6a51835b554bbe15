"""motor_lag_asymmetry: rotors slow down in another time than they speed up."""

from __future__ import annotations

from collections.abc import Mapping

from greybox.model.effect import Effect, Flow, Needs, ReferenceCase
from greybox.model.parameter import Parameter
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr


class MotorLagAsymmetry(Effect):
    """tau_up = tau (1 - a) where a rotor speeds up, tau_down = tau (1 + a) where it slows down, tau
    that of motor_lag.

    A speed controller that does not brake leaves slowing down to the drag of the propeller: a > 0.
    Each part of the way is integrated exactly, as with one time constant: a first-order lag never
    overshoots its goal.
    """

    name = "motor_lag_asymmetry"
    stage = "rotor"
    summary = "rotors slow down more slowly than they speed up"
    formula = "tau_up = tau (1 - a), tau_down = tau (1 + a)"
    references = (
        "Furrer, Burri, Achtelik and Siegwart 2016, RotorS: a modular Gazebo MAV simulator "
        "framework (time constants up and down)",
    )
    validity = "next to motor_lag; one time constant each way"
    needs = Needs(effects=("motor_lag",))
    early = frozenset({"lag_asymmetry"})
    case = ReferenceCase(
        parameters={"a": 0.3},
        flow={},
        expected={"lag_asymmetry": 0.3},
        working="the asymmetry is the parameter itself",
    )

    def parameters(self, vehicle: Vehicle) -> tuple[Parameter, ...]:
        """The asymmetry a [-]."""
        return (
            Parameter(
                name="a",
                unit="-",
                nominal=0.0,
                lower=-0.95,
                upper=0.95,
                null=0.0,
                scale=0.2,
                meaning="asymmetry of the time constant",
            ),
        )

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """The model knows it before the lag is used."""
        return {"lag_asymmetry": p["a"]}
