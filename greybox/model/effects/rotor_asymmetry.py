"""rotor_asymmetry: rotors differ in strength."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca

from greybox.model.effect import Effect, Flow, ReferenceCase
from greybox.model.parameter import Parameter
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr


class RotorAsymmetry(Effect):
    """T_i and Q_i scaled by 1 + delta_i with sum(delta) = 0: the common part belongs to the thrust
    map.

    delta_1 .. delta_(n-1) are parameters; delta_n = -(delta_1 + ... + delta_(n-1)) is derived.
    """

    name = "rotor_asymmetry"
    stage = "thrust"
    summary = "one rotor is weaker or stronger than the others"
    formula = "T_i <- T_i (1 + delta_i), Q_i <- Q_i (1 + delta_i), sum(delta) = 0"
    references = (
        "Freddi, Lanzon and Longhi 2011, A feedback linearization approach to fault tolerance in "
        "quadrotors",
    )
    validity = "|delta_i| < 1"
    tags = frozenset({"linear-in-parameters"})
    case = ReferenceCase(
        parameters={"delta_1": 0.1, "delta_2": -0.02, "delta_3": 0.0},
        flow={},
        expected={"thrust_factor": (1.1, 0.98, 1.0, 0.92), "torque_factor": (1.1, 0.98, 1.0, 0.92)},
        working="delta_4 = -(0.1 - 0.02 + 0) = -0.08",
    )

    def parameters(self, vehicle: Vehicle) -> tuple[Parameter, ...]:
        """delta_1 .. delta_(n-1) [-]."""
        return tuple(
            Parameter(
                name=f"delta_{i}",
                unit="-",
                nominal=0.0,
                lower=-0.9,
                upper=0.9,
                null=0.0,
                scale=0.05,
                meaning=f"relative strength of rotor {i}",
            )
            for i in range(1, len(vehicle.rotors))
        )

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """The same factor on thrust and drag torque."""
        delta = list(p.values())
        factor = ca.vertcat(*(1 + d for d in delta), 1 - sum(delta))
        return {"thrust_factor": factor, "torque_factor": factor}

    def derived(self, p: Mapping[str, Expr], vehicle: Vehicle) -> Mapping[str, Expr]:
        """The last rotor's share."""
        return {f"delta_{len(vehicle.rotors)}": -sum(p.values())}
