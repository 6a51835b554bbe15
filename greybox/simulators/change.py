"""Change: what a simulator makes of an effect, as a change of our own model.

A simulator that has no term for an effect flies the model without it; one that has a simpler term
flies the model with that term instead. So what is lost can be computed and flown here, before the
simulator runs.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

from greybox.model.effect import Effect
from greybox.simulators.craft import Craft


@dataclass(frozen=True, kw_only=True)
class Change:
    """`values` replace parameters of the model; `without` effects leave it; `instead` come in, with
    their parameters in `values` as effect.parameter; `gravity` [m/s^2] replaces the vehicle's."""

    values: Mapping[str, float] = field(default_factory=dict)
    without: tuple[str, ...] = ()
    instead: tuple[Effect, ...] = ()
    gravity: float | None = None

    def __bool__(self) -> bool:
        return bool(self.values or self.without or self.instead or self.gravity is not None)

    def then(self, after: Change) -> Change:
        """Both in one, the other `after` this one."""
        return Change(
            values={**self.values, **after.values},
            without=(*self.without, *after.without),
            instead=(*(e for e in self.instead if e.name not in after.without), *after.instead),
            gravity=self.gravity if after.gravity is None else after.gravity,
        )


def changed(craft: Craft, changes: Iterable[Change]) -> Craft:
    """The craft after all of the changes."""
    values, without, instead = dict(craft.values), set[str](), list[Effect]()
    gravity = None
    for change in changes:
        values.update(change.values)
        without |= set(change.without)
        instead += change.instead
        gravity = change.gravity if change.gravity is not None else gravity
    physics = craft.physics
    if without:
        kept = tuple(e for e in physics.effects if e.name not in without)
        physics = replace(physics, effects=kept)
    if instead:
        physics = physics.with_effect(*instead)
    if gravity is not None:
        physics = replace(physics, vehicle=replace(physics.vehicle, gravity=gravity))
    return replace(
        craft,
        physics=physics,
        values={d.name: values.get(d.name, d.nominal) for d in physics.parameters},
    )
