"""payload_mass: the craft carries more, or less, than its vehicle file says."""

from __future__ import annotations

from collections.abc import Mapping

from greybox.model.effect import Effect, Flow, ReferenceCase
from greybox.model.parameter import Parameter
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr


class PayloadMass(Effect):
    """m <- m (1 + mu): a load at the centre of mass; inertia and centre of mass stay as they are.

    Motion and specific force show thrust over mass only, so that mu is collinear with a free thrust
    scale: it can be judged where the thrust map is exact or torques pin it.
    """

    name = "payload_mass"
    stage = "body"
    summary = "the craft is heavier or lighter than stated"
    formula = "m <- m (1 + mu)"
    references = (
        "Pounds, Bersak and Dollar 2012, Stability of small-scale UAV helicopters and quadrotors "
        "with added payload mass under PID control, Autonomous Robots 33",
    )
    validity = "a load fixed near the centre of mass; not separable from a free thrust scale"
    tags = frozenset({"linear-in-parameters"})
    case = ReferenceCase(
        parameters={"mu": 0.15},
        flow={},
        expected={"mass_factor": 1.15},
        working="a load of 15 % of the mass: 1 + 0.15",
    )

    def parameters(self, vehicle: Vehicle) -> tuple[Parameter, ...]:
        """mu [-], the load as a share of the mass."""
        return (
            Parameter(
                name="mu",
                unit="-",
                nominal=0.0,
                lower=-0.5,
                upper=2.0,
                null=0.0,
                scale=0.1,
                origin=-1.0,
                meaning="load over mass",
            ),
        )

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """Factors of the mass multiply."""
        return {"mass_factor": 1 + p["mu"]}
