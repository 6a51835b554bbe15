"""ground_effect: rotors thrust more near the ground."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca

from greybox.model.effect import Effect, Flow, Needs, ReferenceCase
from greybox.model.parameter import Parameter
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr


class GroundEffect(Effect):
    """T_i <- T_i / (1 - k (R / 4 z_i)^2), z_i the height of hub i above a level ground at z = 0 of
    the world.

    k = 1 is the isolated rotor of Cheeseman and Bennett; multirotors gain more near the ground
    (Sanchez-Cuevas, Heredia and Ollero 2017). Below z_i = R/2, where the law does not hold, the
    factor keeps the value that it has there; it is never above 4, which k <= 3 does not reach.
    """

    name = "ground_effect"
    stage = "thrust"
    summary = "thrust grows near the ground"
    formula = "T_i <- T_i / (1 - k (R / 4 z_i)^2)"
    references = (
        "Cheeseman and Bennett 1955, The effect of the ground on a helicopter rotor in forward "
        "flight, ARC R&M 3021",
        "Sanchez-Cuevas, Heredia and Ollero 2017, Characterization of the Aerodynamic Ground "
        "Effect and Its Influence in "
        "Multirotor Control, International Journal of Aerospace Engineering 2017, 1823056",
    )
    validity = (
        "hubs higher than half a rotor radius over level ground at z = 0, slow flight; lower than "
        "about two radii fit with the kalman predictor, whose gain follows the height"
    )
    needs = Needs(vehicle=("actuator.rotor_radius",), sensors=("position",))
    case = ReferenceCase(
        parameters={"k": 1.6},
        flow={
            "position": (5.0, 5.0, 0.0635),
            "rotation": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
            "arms": ((0.1, -0.1, -0.1, 0.1), (-0.1, -0.1, 0.1, 0.1), (0.0, 0.0, 0.0, -0.0635)),
        },
        expected={
            "thrust_factor": (
                1.1111111111111112,
                1.1111111111111112,
                1.1111111111111112,
                1.6666666666666667,
            )
        },
        working="R = 0.0635 m. At z = R: R/4z = 1/4, 1 / (1 - 1.6/16) = 1/0.9. On the ground as at "
        "z = R/2: 1 / (1 - 1.6/4) = 1/0.6",
    )

    def parameters(self, vehicle: Vehicle) -> tuple[Parameter, ...]:
        """k [-]; the fuselage of a small multirotor collects several rotors' worth of it."""
        return (
            Parameter(
                name="k",
                unit="-",
                nominal=0.0,
                lower=0.0,
                upper=40.0,
                null=0.0,
                scale=0.5,
                meaning="strength, 1 = one rotor",
            ),
        )

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """One factor per rotor, from the height of its own hub."""
        radius = flow.vehicle.actuator.rotor_radius
        assert radius is not None  # what it needs
        height = flow.position[2] + (flow.rotation[2, :] @ flow.arms).T
        ratio = radius / (4 * ca.fmax(height, 0.5 * radius))
        return {"thrust_factor": 1 / (1 - ca.fmin(p["k"] * ratio * ratio, 0.75))}
