"""Laws that simulators have and the catalogue has not: what effects are folded into.

They are effects like any other, so that our own model flies what a simulator will.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import casadi as ca
import numpy as np

from greybox.model.effect import Effect, vector_parameters
from greybox.model.flow import Flow
from greybox.model.parameter import Parameter
from greybox.model.vehicle import Vehicle
from greybox.simulators.change import Change
from greybox.simulators.craft import Craft
from greybox.simulators.words import GYROSCOPIC, Status, Word, Wording
from greybox.symbolic import Expr, FloatArray


class LinearBodyDrag(Effect):
    """F = -diag(d) R^T v through the centre of mass; `wind`: of the airspeed instead."""

    name = "linear_body_drag"
    stage = "wrench"
    summary = "force against the velocity, one coefficient per body axis"
    formula = "F = -diag(d_x, d_y, d_z) v"

    def __init__(self, *, wind: bool) -> None:
        self.wind = wind

    def parameters(self, vehicle: Vehicle) -> tuple[Parameter, ...]:
        """d_x, d_y, d_z [N s/m]."""
        return vector_parameters("d_", "xyz", unit="N s/m", scale=1.0, meaning="drag")

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """Force through the centre of mass."""
        velocity = flow.velocity - flow.wind if self.wind else flow.velocity
        gain: Expr = ca.vertcat(p["d_x"], p["d_y"], p["d_z"])
        return {"force": -gain * velocity}


def linear_drag(craft: Craft) -> FloatArray:
    """d (3,) [N s/m] that rotor drag and inflow have at hover speed, and parasitic drag at the
    typical speed of the training flights."""
    total = craft.count * craft.hover_nu * craft.speed_max
    d = np.array(
        [
            craft.per_speed("rotor_drag.k_x"),
            craft.per_speed("rotor_drag.k_y"),
            craft.per_speed("axial_inflow.k_z"),
        ]
    )
    return total * d + typical_speed(craft) * craft.vector("parasitic_drag.c_")


def typical_speed(craft: Craft) -> float:
    """Root mean square speed of points drawn evenly from the training domain [m/s]."""
    boxes = [craft.domain.get(f"v{a}", (0.0, 0.0)) for a in "xyz"]
    return math.sqrt(sum((a * a + a * b + b * b) / 3.0 for a, b in boxes))


class NotGyroscopic(Effect):
    """M = omega x J omega: takes the gyroscopic moment of a body with moments J away."""

    name = "not_gyroscopic"
    stage = "wrench"
    summary = "no gyroscopic moment of the body"
    formula = "M = omega x J omega"

    def parameters(self, vehicle: Vehicle) -> tuple[Parameter, ...]:
        """Jx, Jy, Jz [kg m^2]."""
        return tuple(
            Parameter(name=f"J{a}", unit="kg m^2", nominal=0.0, null=0.0, meaning="moment")
            for a in "xyz"
        )

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """Moment about the centre of mass."""
        j: Expr = ca.vertcat(p["Jx"], p["Jy"], p["Jz"])
        return {"moment": ca.cross(flow.omega, j * flow.omega)}


def no_gyroscopic_moment(wording: Wording, why: str) -> None:
    """A row for a simulator whose body has no gyroscopic moment, and three moments of inertia."""
    j = wording.craft.inertia
    values = {f"not_gyroscopic.J{a}": float(j[i, i]) for i, a in enumerate("xyz")}
    change = Change(instead=(NotGyroscopic(),), values=values)
    wording.add(Word(effect=GYROSCOPIC, status=Status.LOST, how=why, change=change))


DRAGS = ("rotor_drag", "axial_inflow", "parasitic_drag")


def fold_drag(
    wording: Wording,
    how: str,
    d: FloatArray | None = None,
    *,
    wind: bool,
    of: tuple[str, ...] = DRAGS,
) -> None:
    """Rows for a simulator whose drag is linear in the body's velocity: the effects `of` become one
    linear drag `d` (default: `linear_drag`). The whole change stands in the first row."""
    there = tuple(n for n in of if n in wording.craft.effects)
    if not there:
        return
    gain = linear_drag(wording.craft) if d is None else d
    values = {f"linear_body_drag.d_{a}": float(v) for a, v in zip("xyz", gain, strict=True)}
    whole = Change(without=there, instead=(LinearBodyDrag(wind=wind),), values=values)
    wording.folded(
        there[0],
        f"{how}, at hover speed" + (f" (with {', '.join(there[1:])})" if there[1:] else ""),
        whole,
    )
    for name in there[1:]:
        wording.folded(name, f"{how}, in the row of {there[0]}", Change())


def drag_of(craft: Craft) -> FloatArray:
    """d (3,) of a craft that was folded by `fold_drag`; zeros where nothing was."""
    return craft.vector("linear_body_drag.d_")
