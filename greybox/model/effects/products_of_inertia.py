"""products_of_inertia: the principal axes are not the body axes."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca
import numpy as np

from greybox.model.effect import Effect, Flow, ReferenceCase
from greybox.model.parameter import Parameter
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr

SHARE = 0.25
"""Share of what would make the scaled inertia matrix singular that each product may reach."""


class ProductsOfInertia(Effect):
    """Off-diagonal elements J[0,1], J[0,2], J[1,2] of the inertia matrix, added to those of the
    vehicle file.

    Bounds: with D the diagonal of the vehicle file's J and lambda the smallest eigenvalue of D^-1/2
    J D^-1/2, each
    |J_ij| is at most lambda/4 sqrt(J_ii J_jj). All three at their bounds take at most lambda/2 of lambda, so that J
    stays positive definite as long as the moments stay above 1 - lambda/2 of their stated values (half of them for a
    diagonal J).
    """

    name = "products_of_inertia"
    stage = "body"
    summary = "off-diagonal elements of the inertia matrix"
    formula = "J <- J + [[0, Jxy, Jxz], [Jxy, 0, Jyz], [Jxz, Jyz, 0]]"
    references = (
        "Goldstein, Poole and Safko 2002, Classical Mechanics, ch. 5 (the inertia tensor)",
    )
    validity = "small against the moments: bounds keep J positive definite"
    tags = frozenset({"linear-in-parameters"})
    case = ReferenceCase(
        parameters={"Jxy": 1e-4, "Jxz": -2e-4, "Jyz": 3e-4},
        flow={},
        expected={"inertia_increment": ((0.0, 1e-4, -2e-4), (1e-4, 0.0, 3e-4), (-2e-4, 3e-4, 0.0))},
        working="the matrix elements themselves, once on each side of the diagonal",
    )

    def parameters(self, vehicle: Vehicle) -> tuple[Parameter, ...]:
        """Jxy, Jxz, Jyz [kg m^2]: matrix elements, not the integrals with the other sign."""
        inertia = np.asarray(vehicle.inertia)
        root = np.sqrt(np.diag(inertia))
        limit = (
            SHARE
            * float(np.linalg.eigvalsh(inertia / np.outer(root, root))[0])
            * np.outer(root, root)
        )
        return tuple(
            Parameter(
                name=name,
                unit="kg m^2",
                nominal=0.0,
                lower=-float(limit[i, j]),
                upper=float(limit[i, j]),
                null=0.0,
                scale=0.2 * float(limit[i, j]),
                meaning=f"inertia matrix element {name[1:]}",
            )
            for name, i, j in (("Jxy", 0, 1), ("Jxz", 0, 2), ("Jyz", 1, 2))
        )

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """The symmetric increment of the inertia matrix."""
        xy, xz, yz = p["Jxy"], p["Jxz"], p["Jyz"]
        rows = (ca.horzcat(0, xy, xz), ca.horzcat(xy, 0, yz), ca.horzcat(xz, yz, 0))
        return {"inertia_increment": ca.vertcat(*rows)}
