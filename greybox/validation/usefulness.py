"""Is a model useful, and how far ahead? Its errors against holding the last value and against the
measured IMU.

A model that does not beat the last measured value knows nothing (ceiling); one that comes near dead
reckoning with the measured IMU has nothing left to gain (floor). `judge` turns the three multi-step
tables of a validation into one `Verdict`, whose first line is the first line of every output: of
all flights together, and of every flight and axis alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from greybox.errors import DataError
from greybox.model.verdict import Outcome, Part, Verdict
from greybox.symbolic import FloatArray
from greybox.validation.advice import Hint
from greybox.validation.comparison import (
    Alone,
    Comparison,
    Grid,
    Standard,
    Weighed,
    compare,
    nearest,
    weigh,
)
from greybox.validation.finding import conclude, not_usable_on_most, partly_judged, skill_of
from greybox.validation.horizon_table import GroupErrors, HorizonTable
from greybox.validation.parts import denies, useful_alone, useful_on

TEST_FLIGHTS = "flights that it was not fitted to"
FITTED_FLIGHTS = "the flights that were fitted"
PARTLY_FITTED = "flights of which some were fitted"
LEFT_OUT = "pieces of the training flights that were left out"
IN_SHORT = {LEFT_OUT: "on pieces left out"}
"""What is too long for the first line."""


def judge(
    model: HorizonTable,
    last_value: HorizonTable,
    measured_imu: HorizonTable | None = None,
    *,
    judged_on: str = TEST_FLIGHTS,
    hints: Iterable[Hint] = (),
    standard: Standard | None = None,
) -> Verdict:
    """The verdict on a model from its multi-step errors, those of holding the last value, and of
    dead reckoning.

    The tables are those of `greybox.validation.validate.Validation` (the same origins in all).
    Horizons are every sample up to `standard.longest`, as far as the tables reach. A group that was
    measured and has no errors (`unjudged` of the model's table), or none where skill is stated, is
    named, and what is left is at best judged in part. `hints` are what else was seen
    (`greybox.validation.advice`). Raises `DataError` where the tables share no group or end before
    `standard.minimum`.
    """
    rule = standard or Standard()
    whole = _Tables(model=model, last=last_value, floor=measured_imu)
    groups, grid = _judged(model, last_value, rule)
    lost = [g for g in model.groups if g in last_value.groups and g not in groups]
    weighed = weigh(_compared_of(whole, groups, grid), grid)
    axes = _axes(whole, groups, grid)
    flights = _flights(whole, rule)
    parts = [_part(n, "flight", w, g) for n, w, g in flights]
    parts += [_part(c.name, "axis", weigh([c], grid), grid) for c in axes]
    useful = weighed.useful(grid)
    kept = [c for c, p in zip(axes, parts[len(flights) :], strict=True) if _kept(p, useful)]
    # A flight that taught may spoil what it is foretold well by.
    good = {p.name for p in useful_on(parts) if judged_on == TEST_FLIGHTS}
    hints = [h for h in hints if h.flight not in good]
    found = conclude(weighed, grid, hints, parts, kept)
    if found.outcome is Outcome.NOT_USABLE:
        found = replace(found, why=(*found.why, *useful_alone(parts)))
    elif most := _most(flights, parts):
        found = not_usable_on_most(most, parts, hints)
        useful = most[0][1].useful(most[0][2])
    found = partly_judged(found, [*lost, *model.unjudged])
    on = f" [{IN_SHORT.get(judged_on, f'judged on {judged_on}')}]"
    return Verdict(
        outcome=found.outcome,
        line=found.line + ("" if judged_on == TEST_FLIGHTS else on),
        useful_seconds=useful,
        judged_seconds=float(grid.seconds[-1]),
        judged_on=judged_on,
        flights=tuple(model.flights),
        groups=tuple(skill_of(c, grid) for c in weighed.compared),
        reason=found.reason,
        action=found.action,
        anchor=found.anchor,
        why=found.why,
        parts=tuple(parts),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Tables:
    """The errors that are compared: of the model, of the last value and of dead reckoning."""

    model: HorizonTable
    last: HorizonTable
    floor: HorizonTable | None

    def of(self, flight: str) -> _Tables:
        """Those of one flight."""

        def one(table: HorizonTable) -> HorizonTable:
            return replace(table, groups=table.flights.get(flight, {}), flights={})

        floor = None if self.floor is None else one(self.floor)
        return _Tables(model=one(self.model), last=one(self.last), floor=floor)

    def floor_of(self, group: str) -> GroupErrors | None:
        """The errors of dead reckoning, None where there are none."""
        return None if self.floor is None else self.floor.groups.get(group)


def _compared_of(tables: _Tables, groups: Iterable[str], grid: Grid) -> list[Comparison]:
    """The groups, each as a whole."""
    model, last = tables.model, tables.last
    return [
        compare(model.kinds[g], model.groups[g], last.groups[g], tables.floor_of(g), grid)
        for g in groups
    ]


def _axes(tables: _Tables, groups: Iterable[str], grid: Grid) -> list[Comparison]:
    """Every axis of the groups, over all flights."""
    out = []
    for g in groups:
        kind, floor = tables.model.kinds[g], tables.floor_of(g)
        own, held = tables.model.groups[g].axes, tables.last.groups[g].axes
        best = () if floor is None else floor.axes
        for i, name in enumerate(kind.axes if len(own) == len(held) else ()):
            if i < len(own):
                there = best[i] if i < len(best) else None
                out.append(compare(kind, own[i], held[i], there, grid, name=name))
    return out


def _flights(tables: _Tables, rule: Standard) -> list[Alone]:
    """Every flight alone, where there are several; those that are too short to tell an error from
    chance are left out."""
    names = list(tables.model.flights)
    out: list[Alone] = []
    for name in names if len(names) > 1 else ():
        one = tables.of(name)
        if all(len(e.block_sums) < 2 for e in one.model.groups.values()):
            continue
        try:
            groups, grid = _judged(one.model, one.last, rule)
        except DataError:  # too short to judge by
            continue
        out.append((name, weigh(_compared_of(one, groups, grid), grid), grid))
    return out


def _part(name: str, kind: Literal["flight", "axis"], weighed: Weighed, grid: Grid) -> Part:
    """A flight or an axis alone, by the same rule as all together."""
    outcome, ends = Outcome.USABLE, weighed.ends
    ended = [c for c in weighed.counted if c.worse[ends : ends + 1].any()]
    if weighed.lost(grid) or any(not c.calm for c in weighed.idle):
        outcome = Outcome.NOT_USABLE
        ended = ended or list(weighed.wrecked or weighed.idle)
    elif weighed.excused or weighed.idle:
        outcome = Outcome.TOO_CALM
        ended = [*weighed.excused, *weighed.idle]
    return Part(
        name=name,
        kind=kind,
        outcome=outcome,
        useful_seconds=weighed.useful(grid),
        groups=tuple(dict.fromkeys(c.name for c in ended)),
        worse_from=float(grid.seconds[ends]) if ends < len(grid.seconds) else None,
    )


def _kept(axis: Part, useful: float) -> bool:
    """Whether an axis is judged, and as useful as all together."""
    return axis.outcome is Outcome.USABLE and not denies(axis, useful)


def _most(flights: Sequence[Alone], parts: Sequence[Part]) -> list[Alone]:
    """The flights on which the model is not usable alone, the worst first, where they are more than
    half of those that can be judged: what holds on the others does not make it usable."""
    own = {p.name: p for p in parts if p.kind == "flight"}
    judged = [p for p in own.values() if p.outcome is not Outcome.TOO_CALM]
    bad = [f for f in flights if own[f[0]].outcome is Outcome.NOT_USABLE]
    return sorted(bad, key=lambda f: f[1].ends) if 2 * len(bad) > len(judged) else []


def _judged(
    model: HorizonTable, last_value: HorizonTable, rule: Standard
) -> tuple[list[str], Grid]:
    """The groups that have errors where skill is stated, and the horizons. Raises `DataError` as
    `judge`."""
    dt = model.sample_time
    counts = {
        g: np.minimum(model.groups[g].n, last_value.groups[g].n)
        for g in model.groups
        if g in last_value.groups
    }
    groups = [g for g, n in counts.items() if n.any()]
    while True:
        steps = min(model.steps, last_value.steps, round(rule.longest / dt)) if groups else 0
        for g in groups:
            reached = np.flatnonzero(counts[g] >= max(rule.reach * counts[g].max(), 1))
            steps = min(steps, int(reached[-1]) + 1)
        if steps * dt < rule.minimum - 1e-9:
            raise DataError(
                "not enough to judge a model by",
                expected=f"errors up to {rule.minimum:g} s ahead of at least one channel group",
                got=f"{len(groups)} group(s), {steps * dt:.3g} s",
                fix="longer flights",
            )
        seconds: FloatArray = dt * np.arange(1, steps + 1, dtype=np.float64)
        imu_only = set(groups) <= {"rate", "specific_force"}
        at = nearest(seconds, rule.look_ahead_imu if imu_only else rule.look_ahead)
        there = [g for g in groups if counts[g][at]]
        if there == groups:
            return groups, Grid(seconds=seconds, at=at, rule=rule)
        groups = there
