"""battery_sag: rotors turn slower when the battery voltage falls."""

from __future__ import annotations

from collections.abc import Mapping

from greybox.model.effect import Effect, Flow, Needs, ReferenceCase
from greybox.model.parameter import Parameter
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr


class BatterySag(Effect):
    """Steady rotor speed scales with 1 + c_V (V - V0) / V0; c_V = 1 is a speed proportional to u
    V."""

    name = "battery_sag"
    stage = "rotor"
    summary = "steady rotor speed follows the battery voltage"
    formula = "nu_ss <- nu_ss (1 + c_V (V - V0) / V0)"
    references = (
        "Bitcraze documentation: PWM to thrust, battery compensation of the Crazyflie 2.x",
    )
    validity = "V within about 25 % of the nominal voltage V0"
    tags = frozenset({"linear-in-parameters"})
    needs = Needs(columns=("vbat",), vehicle=("nominal_voltage",))
    case = ReferenceCase(
        parameters={"c_V": 0.8},
        flow={"vbat": 3.4},
        expected={"steady_factor": 0.9157894736842105},
        working="V0 = 3.8 V: 1 + 0.8 * (3.4 - 3.8) / 3.8 = 1 - 0.0842105",
    )

    def parameters(self, vehicle: Vehicle) -> tuple[Parameter, ...]:
        """The voltage coefficient c_V [-]."""
        return (
            Parameter(
                name="c_V",
                unit="-",
                nominal=0.0,
                lower=-1.0,
                upper=3.0,
                null=0.0,
                scale=0.2,
                meaning="voltage factor",
            ),
        )

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """One factor for all rotors."""
        v0 = flow.vehicle.nominal_voltage
        return {"steady_factor": 1 + p["c_V"] * (flow.vbat - v0) / v0}
