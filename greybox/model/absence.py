"""Absence: where an effect is nothing, how large it typically is, and why a log cannot judge it."""

from __future__ import annotations

from collections.abc import Collection

from greybox.errors import GreyboxError
from greybox.model.effect import Effect
from greybox.model.model import PhysicsModel
from greybox.model.vehicle import Vehicle

TYPICAL = 3.0
"""Standard deviation of the prior of an effect that may be there, in units of its declared typical
size: weakly informative (Gelman, Jakulin, Pittau and Su 2008, Annals of Applied Statistics 2(4)); a
factor of three in it moves log evidence by about one per parameter."""


def absence(effect: Effect, vehicle: Vehicle) -> dict[str, tuple[float, float]]:
    """Full name of every parameter -> (value at which the effect is absent, standard deviation
    about it). One without a null is a shape, typical at its nominal value."""
    return {
        f"{effect.name}.{d.name}": (
            float(d.nominal if d.null is None else d.null),
            TYPICAL * d.scale,
        )
        for d in effect.parameters(vehicle)
    }


def moved_numbers(effect: Effect, vehicle: Vehicle, why: str) -> list[str]:
    """Numbers that an effect moves under their own name, whose sigma is there for `why`."""
    slots = effect.case.expected if effect.stage == "body" else ()
    return [b.quantity for b in vehicle.beliefs.entries if b.why == why and b.group in slots]


def not_offered(effect: Effect, bare: PhysicsModel, columns: Collection[str]) -> str | None:
    """Why a log with these columns cannot judge an effect beside the model `bare`; None where it
    can."""
    missing = [c for c in effect.needs.columns if c not in columns]
    if missing:
        return f"no {', '.join(missing)}"
    if stated := moved_numbers(effect, bare.vehicle, "stated"):  # what flights deny is said
        return f"the vehicle file states {', '.join(stated)}"
    try:
        bare.with_effect(effect)
    except GreyboxError as error:
        return str(error)
    return None
