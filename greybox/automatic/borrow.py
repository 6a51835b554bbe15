"""Whether a craft borrows the effects of a like one: only where its own flights are foretold better
with them."""

from __future__ import annotations

from dataclasses import replace

from greybox.automatic.decide import Decided, decide
from greybox.automatic.facts import Facts, facts_of
from greybox.automatic.fit import Prepared, fit_recipe
from greybox.automatic.like import like
from greybox.automatic.setting import Given
from greybox.automatic.trials import Say
from greybox.data import Dataset
from greybox.errors import FitError
from greybox.estimation.recipe import Decision
from greybox.estimation.status import Interrupted
from greybox.model.vehicle import Vehicle


def decide_for(
    vehicle: Vehicle, prepared: Prepared, given: Given, *, say: Say = lambda text: None
) -> tuple[Vehicle, Decided]:
    """`decide_with_source` for flights that are prepared. An interrupted trial is no result."""
    facts = facts_of(prepared.data, vehicle, prepared.report)
    try:
        return decide_with_source(vehicle, prepared.data, facts, given, say=say)
    except Interrupted:
        raise KeyboardInterrupt from None


def decide_with_source(
    vehicle: Vehicle, data: Dataset, facts: Facts, given: Given, *, say: Say = lambda text: None
) -> tuple[Vehicle, Decided]:
    """`decide` with the effects of the model `given.source` in the vehicle and without, and the
    vehicle of the better of both.

    Craft that look alike may fly otherwise, and an effect that this one does not have costs more
    than few seconds can correct. The pieces that are left out judge, by the errors ahead; where
    every flight is too short to leave one out, the whole flights, by their likelihood with the
    borrowed priors paid for. Raises what `decide` raises.
    """
    if given.source is None:
        return vehicle, decide(vehicle, data, facts, given, say=say)
    borrowed = like(vehicle, given.source, facts)
    new = [n for n in borrowed.effects if n not in vehicle.effects]
    name = given.source.name
    say(f"with {', '.join(new) or 'nothing new'} of {name}:")
    theirs = decide(borrowed, data, facts, given, say=say)
    if not new:
        return borrowed, theirs
    say(f"without what {name} says:")
    ours = decide(vehicle, data, facts, replace(given, source=None), say=say)
    taken, why = _better(vehicle, borrowed, data, ours, theirs)
    choice = ", ".join(new) if taken else "nothing"
    decision = Decision(about=f"borrowed from {name}", choice=choice, reason=why, option="--from")
    say(f"  {decision.about}: {choice} ({why})")
    one = theirs if taken else ours
    return borrowed if taken else vehicle, replace(one, decisions=(decision, *one.decisions))


def _better(
    vehicle: Vehicle, borrowed: Vehicle, data: Dataset, ours: Decided, theirs: Decided
) -> tuple[bool, str]:
    """(whether what was borrowed is of use, the reason)."""
    if ours.candidate is not None and theirs.candidate is not None:
        own, other = ours.candidate.score, theirs.candidate.score
        gain, error = other.better_by(own)
        return gain > error, (
            f"squared error ahead, on pieces left out, {other.mean:.3f} of the last value's with "
            f"them, {own.mean:.3f} without"
        )
    costs = []
    for craft, decided in ((vehicle, ours), (borrowed, theirs)):
        try:
            found = fit_recipe(craft, data, decided.recipe)
        except FitError:
            costs.append(float("inf"))
        else:
            costs.append(found.cost)
    gained = costs[0] - costs[1]
    return gained > 0, f"log likelihood of all flights, their priors paid for, {gained:+.1f}"
