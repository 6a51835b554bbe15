"""command_delay: the command acts d seconds after it was logged."""

from __future__ import annotations

from collections.abc import Mapping

from greybox.model.effect import Effect, Flow, ReferenceCase, delay_parameters
from greybox.model.parameter import Parameter
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr


class CommandDelay(Effect):
    """u_eff(t) = u(t - d), by interpolation of the record; slope at the null -du/dt."""

    name = "command_delay"
    stage = "command"
    summary = "transport delay between the logged command and the motors"
    formula = "u_eff(t) = u(t - d)"
    references = ("Ljung 1999, System Identification: Theory for the User, sec. 4.2 (input delay)",)
    validity = (
        "0 .. the model's longest delay; of a held command mean and first moment over the "
        "step are exact"
    )
    early = frozenset({"delay"})
    beyond = (
        "commands are logged about {0:.2g} s later than they act, or physics that the model lacks "
        "looks like that (greybox discover); where they are late, add {1:.3g} (whole rows) to the "
        "delay in [columns.command] (0 where none is said) and fit again"
    )
    case = ReferenceCase(
        parameters={"d": 0.02},
        flow={},
        expected={"delay": 0.02},
        working="the delay is the parameter itself",
    )

    def parameters(self, vehicle: Vehicle) -> tuple[Parameter, ...]:
        """The delay d [s]."""
        return delay_parameters("command delay", 0.0, 0.1)

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """Delays of the command stage add."""
        return {"delay": p["d"]}
