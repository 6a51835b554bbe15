"""center_of_mass_offset: the centre of mass is not where the vehicle file says."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca

from greybox.model.effect import Effect, Flow, ReferenceCase, vector_parameters
from greybox.model.parameter import Parameter
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr


class CenterOfMassOffset(Effect):
    """Every rotor arm becomes r_i - c and every sensor's lever arm follows; no separate gravity
    moment."""

    name = "center_of_mass_offset"
    stage = "body"
    summary = "the centre of mass lies c away from its stated place"
    formula = "r_i <- r_i - c, sensor lever arms likewise"
    references = (
        "Goldstein, Poole and Safko 2002, Classical Mechanics, ch. 5 (moments about the centre of "
        "mass)",
    )
    validity = "|c| below the arm length"
    tags = frozenset({"linear-in-parameters"})
    case = ReferenceCase(
        parameters={"c_x": 1e-3, "c_y": -2e-3, "c_z": 0.5e-3},
        flow={},
        expected={"center_of_mass": (1e-3, -2e-3, 0.5e-3)},
        working="the offset adds to the vehicle file's centre of mass",
    )

    def parameters(self, vehicle: Vehicle) -> tuple[Parameter, ...]:
        """c_x, c_y, c_z [m]."""
        limit = vehicle.arm_length
        return vector_parameters(
            "c_",
            "xyz",
            unit="m",
            scale=0.03 * limit,
            meaning="centre-of-mass offset",
            lower=-limit,
            upper=limit,
        )

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """The increment of the centre of mass."""
        return {"center_of_mass": ca.vertcat(p["c_x"], p["c_y"], p["c_z"])}
