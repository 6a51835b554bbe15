"""Laws that simulators have and the catalogue has not: what effects are folded into.

They are effects like any other, so that our own model flies what a simulator will.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import casadi as ca
import numpy as np

from greybox.model.effect import Effect
from greybox.model.effects import effect_by_name
from greybox.model.effects.linear_drag import LinearDrag
from greybox.model.flow import Flow
from greybox.model.parameter import Parameter
from greybox.model.vehicle import Vehicle
from greybox.simulators.change import Change
from greybox.simulators.craft import Craft
from greybox.simulators.words import GYROSCOPIC, Status, Word, Wording
from greybox.symbolic import Expr, FloatArray


class DragOfGroundSpeed(LinearDrag):
    """F = -diag(d) R^T v: the linear drag of a simulator that knows no wind."""

    formula = "F_j = -d_j v_j"

    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """Force through the centre of mass, as in still air."""
        return super().apply(replace(flow, wind=ca.DM.zeros(3)), p)


def drag_at_hover(craft: Craft) -> FloatArray:
    """d (3,) [N s/m] of all drags together: of rotor drag and inflow at hover speed, of parasitic
    drag at the typical speed of the training flights."""
    rotors = np.array([craft.get(n) for n in OF_ROTORS])
    fuselage = typical_speed(craft) * craft.vector("parasitic_drag.c_")
    return _sum_of_speeds(craft) * rotors + fuselage + craft.vector("linear_drag.d_")


def _sum_of_speeds(craft: Craft) -> float:
    """Of all rotors at hover, in the units that the drag of the rotors has."""
    return craft.count * craft.hover_nu * craft.physics.vehicle.omega_scale


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


OF_ROTORS = ("rotor_drag.k_x", "rotor_drag.k_y", "axial_inflow.k_z")
DRAGS = ("rotor_drag", "axial_inflow", "linear_drag", "parasitic_drag")


def fold_drag(
    wording: Wording,
    how: str,
    d: FloatArray | None = None,
    *,
    wind: bool,
    of: tuple[str, ...] = DRAGS,
) -> None:
    """Rows for a simulator whose drag is linear in the body's velocity: the effects `of` become one
    linear drag `d` (default: `drag_at_hover`). The whole change stands in the first row."""
    there = tuple(n for n in of if n in wording.craft.effects)
    if not there:
        return
    gain = drag_at_hover(wording.craft) if d is None else d
    same_air = wind or "steady_wind" not in wording.craft.effects
    if there == ("linear_drag",) and same_air and np.array_equal(gain, drag_of(wording.craft)):
        wording.said("linear_drag", how)
        return
    values = {f"linear_drag.d_{a}": float(v) for a, v in zip("xyz", gain, strict=True)}
    law = LinearDrag() if wind else DragOfGroundSpeed()
    whole = Change(without=there, instead=(law,), values=values)
    wording.folded(
        there[0],
        how
        + ", at hover speed" * (there != ("linear_drag",))
        + (f" (with {', '.join(there[1:])})" if there[1:] else ""),
        whole,
    )
    for name in there[1:]:
        wording.folded(name, f"{how}, in the row of {there[0]}", Change())


def drag_of(craft: Craft) -> FloatArray:
    """d (3,) of a craft that was folded by `fold_drag`; zeros where it has no drag."""
    return craft.vector("linear_drag.d_")


def drag_into_rotors(wording: Wording) -> None:
    """The row of a linear drag of the body in a simulator that knows drag of the rotors: it becomes
    drag and inflow of the rotors at hover speed. Rows after it are of the craft that has these."""
    craft = wording.craft
    if "linear_drag" not in craft.effects:
        return
    share = drag_of(craft) / _sum_of_speeds(craft)
    values = {n: craft.get(n) + float(d) for n, d in zip(OF_ROTORS, share, strict=True)}
    have = {e.name for e in craft.physics.effects}
    missing = tuple(effect_by_name(n) for n in ("rotor_drag", "axial_inflow") if n not in have)
    whole = Change(without=("linear_drag",), instead=missing, values=values)
    wording.becomes("linear_drag", "as drag and inflow of the rotors, equal at hover speed", whole)
