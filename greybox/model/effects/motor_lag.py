"""motor_lag: rotors reach their speed with a first-order lag."""

from __future__ import annotations

from collections.abc import Mapping

from greybox.model.effect import Effect, Flow, ReferenceCase
from greybox.model.parameter import Parameter
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr


class MotorLag(Effect):
    """d nu / dt = (nu_ss - nu) / tau, integrated exactly, so that tau -> 0 is smooth."""

    name = "motor_lag"
    stage = "rotor"
    summary = "first-order lag of the rotor speed"
    formula = "d nu/dt = (nu_ss - nu) / tau"
    references = (
        "Mahony, Kumar and Corke 2012, Multirotor Aerial Vehicles, IEEE Robotics & Automation "
        "Magazine 19(3)",
        "Eschmann, Albani and Loianno 2024, Data-Driven System Identification of Quadrotors "
        "Subject to Motor Delays",
    )
    validity = "one time constant for speeding up and slowing down (see motor_lag_asymmetry)"
    early = frozenset({"lag"})
    case = ReferenceCase(
        parameters={"tau": 0.05},
        flow={},
        expected={"lag": 0.05},
        working="the lag is the parameter itself",
    )

    def parameters(self, vehicle: Vehicle) -> tuple[Parameter, ...]:
        """The time constant tau [s]."""
        return (
            Parameter(
                name="tau",
                unit="s",
                nominal=0.04,
                lower=0.0,
                upper=0.5,
                null=0.0,
                scale=0.02,
                meaning="time constant",
            ),
        )

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """The one lag of the rotor stage."""
        return {"lag": p["tau"]}
