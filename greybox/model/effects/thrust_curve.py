"""thrust_curve: a convex map from command to steady rotor speed."""

from __future__ import annotations

from collections.abc import Mapping

from greybox.model.effect import Effect, Flow, ReferenceCase
from greybox.model.parameter import Parameter
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr


class ThrustCurve(Effect):
    """u_eff = (1 - f) u + f u^2, componentwise; the ends 0 and 1 stay where they are."""

    name = "thrust_curve"
    stage = "command"
    summary = "curvature of the map from command to steady rotor speed"
    formula = "u_eff = (1 - f) u + f u^2"
    references = ("PX4 user guide, parameter THR_MDL_FAC (thrust model factor)",)
    validity = "0 <= u <= 1; monotonic for -1 < f < 1"
    tags = frozenset({"linear-in-parameters"})
    order = 20
    case = ReferenceCase(
        parameters={"f": 0.5},
        flow={"command": (0.0, 0.4, 0.8, 1.0)},
        expected={"command": (0.0, 0.28, 0.72, 1.0)},
        working="u = 0.4: 0.5 * 0.4 + 0.5 * 0.16 = 0.28; u = 0.8: 0.4 + 0.32 = 0.72",
    )

    def parameters(self, vehicle: Vehicle) -> tuple[Parameter, ...]:
        """The curvature f [-]."""
        return (
            Parameter(
                name="f",
                unit="-",
                nominal=0.0,
                lower=-0.99,
                upper=0.99,
                null=0.0,
                scale=0.1,
                meaning="curvature",
            ),
        )

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """The curve on every command."""
        u = flow.command
        return {"command": (1 - p["f"]) * u + p["f"] * u * u}
