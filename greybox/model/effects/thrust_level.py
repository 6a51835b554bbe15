"""thrust_level: all rotors push harder or less hard than the vehicle file says."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca

from greybox.model.effect import Effect, Flow, ReferenceCase
from greybox.model.parameter import Parameter
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr


class ThrustLevel(Effect):
    """T_i and Q_i scaled by 1 + s, constant during a flight.

    Both grow with the density of the air, which falls by 3.5 % for every 10 K and by 1 % for every
    85 m of height, and with what warm motors and a used battery leave of the speed. No file knows
    these, so that every model of `greybox discover` has it; one for each flight where no log says
    how full the battery was.
    """

    name = "thrust_level"
    stage = "thrust"
    summary = "all rotors are stronger or weaker (air density, temperature, battery)"
    formula = "T_i <- T_i (1 + s), Q_i <- Q_i (1 + s)"
    references = (
        "ISO 2533:1975, Standard Atmosphere",
        "Leishman 2006, Principles of Helicopter Aerodynamics, sec. 2.2 (thrust and power "
        "proportional to the density)",
    )
    validity = "constant over a flight"
    tags = frozenset({"linear-in-parameters"})
    case = ReferenceCase(
        parameters={"s": -0.03},
        flow={},
        expected={"thrust_factor": (0.97, 0.97, 0.97, 0.97), "torque_factor": (0.97,) * 4},
        working="1 - 0.03 for every rotor",
    )

    def parameters(self, vehicle: Vehicle) -> tuple[Parameter, ...]:
        """s [-]."""
        return (
            Parameter(
                name="s",
                unit="-",
                nominal=0.0,
                lower=-0.5,
                upper=0.5,
                null=0.0,
                scale=0.01,
                origin=-1.0,
                meaning="relative strength of all rotors",
            ),
        )

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """The same factor on thrust and drag torque of every rotor."""
        factor = ca.vertcat(*[1 + p["s"]] * len(flow.vehicle.rotors))
        return {"thrust_factor": factor, "torque_factor": factor}
