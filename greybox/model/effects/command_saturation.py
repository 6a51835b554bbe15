"""command_saturation: the command is clipped inside the range that the vehicle file states."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca

from greybox.model.effect import Effect, Flow, ReferenceCase
from greybox.model.parameter import Parameter
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr


class CommandSaturation(Effect):
    """u_eff = min(max(u, u_min + a_lo), u_max - a_hi): the limits retreat from u_min and u_max of
    the vehicle file.

    Exactly the identity at a_lo = a_hi = 0, even for a command outside u_min .. u_max. At the null
    the one-sided slope is that of a limit which moves inwards: it is felt only by commands that
    stand at the limit, and zero in a flight whose commands never reach it.
    """

    name = "command_saturation"
    stage = "command"
    summary = "motors saturate inside the range of the logged command"
    formula = "u_eff = clip(u, u_min + a_lo, u_max - a_hi)"
    references = (
        "Faessler, Falanga and Scaramuzza 2017, Thrust Mixing, Saturation, and Body-Rate Control "
        "for Accurate Aggressive Quadrotor Flight, IEEE Robotics and Automation Letters 2(2)",
    )
    validity = (
        "logged command from before the limit; no slope at the null where no command "
        "stands at a limit"
    )
    order = 10
    case = ReferenceCase(
        parameters={"a_lo": 0.1, "a_hi": 0.25},
        flow={"command": (0.0, 0.3, 0.8, 1.0)},
        expected={"command": (0.1, 0.3, 0.75, 0.75)},
        working="limits 0 + 0.1 and 1 - 0.25: 0 rises to 0.1, 0.3 stays, 0.8 and 1 fall to 0.75",
    )

    def parameters(self, vehicle: Vehicle) -> tuple[Parameter, ...]:
        """a_lo, a_hi [-]: how far each limit retreats, at most half of the range."""
        half = 0.5 * (vehicle.actuator.u_max - vehicle.actuator.u_min)
        return tuple(
            Parameter(
                name=name,
                unit="-",
                nominal=0.0,
                lower=0.0,
                upper=half,
                null=0.0,
                scale=0.2 * half,
                meaning=meaning,
            )
            for name, meaning in (
                ("a_lo", "retreat of the lower limit"),
                ("a_hi", "retreat of the upper limit"),
            )
        )

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """What stands beyond the retreated limit is taken off, less what stood beyond the stated
        one."""
        u, low, high = flow.command, flow.vehicle.actuator.u_min, flow.vehicle.actuator.u_max

        def beyond(limit: Expr, sign: int) -> Expr:
            # The branch holds its end, so that the slope of a command at the limit is that of one
            # beyond it.
            over = sign * (u - limit)
            return ca.if_else(over >= 0, over, 0)

        above = beyond(high - p["a_hi"], 1) - beyond(high, 1)
        below = beyond(low + p["a_lo"], -1) - beyond(low, -1)
        return {"command": u - above + below}
