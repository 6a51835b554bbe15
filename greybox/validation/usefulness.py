"""Is a model useful, and how far ahead? Its errors against holding the last value and against the
measured IMU.

A model that does not beat the last measured value knows nothing (ceiling); one that comes near dead
reckoning with the measured IMU has nothing left to gain (floor). `judge` turns the three multi-step
tables of a validation into one `Verdict`, whose first line is the first line of every output.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from greybox.errors import DataError
from greybox.model.verdict import GroupSkill, Outcome, Part, Verdict
from greybox.shown import in_degrees
from greybox.symbolic import BoolArray, FloatArray
from greybox.validation.advice import Hint, Symptom, likely, symptom_of_group
from greybox.validation.groups import Group
from greybox.validation.horizon_table import GroupErrors, HorizonTable
from greybox.validation.parts import (
    denied,
    denies,
    in_brackets,
    in_sentences,
    reservations,
    useful_alone,
)

TEST_FLIGHTS = "flights that it was not fitted to"
FITTED_FLIGHTS = "the flights that were fitted"
PARTLY_FITTED = "flights of which some were fitted"
LEFT_OUT = "pieces of the training flights that were left out"
IN_SHORT = {LEFT_OUT: "pieces left out of training"}
"""What is too long for the first line."""


@dataclass(frozen=True, kw_only=True)
class Standard:
    """What "usable" means: every number that decides, with its reason.

    A group is worse than the last value at a horizon where the mean error of the model is above
    that of the last value by more than `equal` of it plus the smaller of one standard error and
    `noise` of it.
    """

    minimum: float = 0.1
    """[s] No group may be worse up to here. Rotors answer within 0.1 s (lag 20 to 70 ms and a
    delay): a model that loses to the last value before they have is worth nothing to a
    controller."""
    look_ahead: float = 0.5
    """[s] Where skill is stated, and up to where no group may be wrecked: what position controllers
    and the model predictive controller of this package plan ahead."""
    look_ahead_imu: float = 0.3
    """[s] The same where only the IMU was logged: there is no attitude or place to plan for, only
    rates to hold."""
    longest: float = 1.0
    """[s] Nothing is judged beyond: open loop, attitude errors of a second are those of the
    disturbances."""
    wrecked: float = 2.0
    """Times the error of the last value, from which a model misleads whoever plans to
    `look_ahead`."""
    better: float = 0.9
    """Error over error of the last value, geometric mean over the groups of turning (rotation,
    rate) and over those of moving (the others), below which both must come somewhere from `minimum`
    to `look_ahead`. A model that equals the last value everywhere is not useful. (On-board IMU
    logs: 0.94 where motors never answered the commands in the model, 0.5 with their lag.)"""
    equal: float = 0.02
    """Share of the last value's error that nobody would notice."""
    noise: float = 0.1
    """At most this share of the last value's error is forgiven as chance: few blocks must not
    excuse a bad model."""
    short: float = 0.1
    """[s] Up to here the error is that of the state estimate, and the last value is told the
    reference itself, smoothed with later samples included. There dead reckoning, which starts from
    the same estimate, may take its place as rival, up to `unfair` times the last value's error.
    (Real flights: rates one sample ahead equal the last value, .083 to .090 against .090 rad/s.)
    A noise that repeats itself, as vibration does, is foretold by holding a value one period long:
    the last value's error is no less than it was at any shorter time.
    The last specific force is itself the measured IMU, with every constant offset that no filter
    corrects: its error at the end of this time is the rival all through it."""
    unfair: float = 2.0
    """See `short`."""
    reach: float = 0.3
    """Share of the origins that must reach a horizon: a few at the end of a short flight are no
    sample of it."""
    sensor_sample: float = 0.02
    """[s] At sample times up to this the change of a value over one sample is mostly noise."""
    noise_motion: float = 2.0
    """A group moves less than this many times its change over one sample within `look_ahead`:
    motion within noise."""


def standard_of(sample_time: float) -> Standard:
    """The standard of a model that is not a vehicle's, whose own time scale nobody knows: it counts
    samples, as many as the seconds of a vehicle are at 100 Hz (10, 50 and 100). None of its outputs
    is called calm."""
    plain = Standard()
    samples = {n: round(vars(plain)[n] / SPACING) for n in ("minimum", "look_ahead", "longest")}
    return Standard(
        **{n: k * sample_time for n, k in samples.items()}, short=0.0, sensor_sample=0.0
    )


SPACING = 0.01
"""[s] Sample time at which the standard of a vehicle is told in samples."""

CALM = {"position": 0.1, "velocity": 0.15, "rotation": 0.05, "rate": 0.2, "specific_force": 0.3}
"""Mean change of a group [its unit] within half a second below which a flight is calm: a third of
what an indoor flight of medium pace shows (NanoBench test flights: 0.44 m, 0.65 m/s, 0.15 rad, 0.77
rad/s). Below, holding the last value is nearly right whatever flies. A model whose own error is
above twice this is bad in any flight, and is not excused."""

KINDS = (("rotation", "rate"), ("position", "velocity", "specific_force"))
"""Turning and moving: a model that knows one of them says nothing of the other."""

TELLING = {
    "position": "figures of eight at 1 m/s",
    "velocity": "figures of eight at 1 m/s",
    "rotation": "fast figures of eight, or steps of 10 deg in roll and pitch",
    "rate": "steps of 10 deg in roll, pitch and yaw",
    "specific_force": "climbs and descents at 1 m/s",
}
"""The flight that would tell, per group."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Grid:
    """The horizons (H,) that a group is judged at [s], the place of that where skill is stated, and
    the rule."""

    seconds: FloatArray
    at: int
    rule: Standard

    @property
    def ahead(self) -> float:
        """The horizon where skill is stated [s]."""
        return float(self.seconds[self.at])

    @property
    def first(self) -> int:
        """The place of the horizon up to which no group may be worse."""
        return _index(self.seconds, self.rule.minimum)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Comparison:
    """One group on the grid of horizons: errors (H,), and where the last value is better."""

    name: str
    kind: Group
    model: FloatArray
    last: FloatArray
    floor: FloatArray | None
    worse: BoolArray
    calm: bool
    excused: bool


@dataclass(frozen=True, kw_only=True, eq=False)
class _Weighed:
    """The groups by what speaks for and against them, and how many horizons are useful."""

    compared: Sequence[_Comparison]
    counted: Sequence[_Comparison]
    """All but the excused ones."""
    excused: Sequence[_Comparison]
    """Worse than the last value, in flights that are too calm to tell."""
    idle: Sequence[_Comparison]
    """Nowhere better than the last value."""
    wrecked: Sequence[_Comparison]
    """So bad that whoever plans ahead is misled."""
    ends: int
    """Horizons before the first one at which a counted group is worse."""

    def lost(self, grid: _Grid) -> bool:
        """Whether a group is worse too early, or wrecked."""
        return self.ends <= grid.first or bool(self.wrecked)

    def useful(self, grid: _Grid) -> float:
        """How far ahead the model is useful [s]."""
        return float(grid.seconds[self.ends - 1]) if self.ends else 0.0


@dataclass(frozen=True, kw_only=True)
class _Finding:
    """What is concluded, in words; fields as those of `Verdict`."""

    outcome: Outcome
    line: str
    why: tuple[str, ...]
    reason: str = ""
    action: str = ""
    anchor: str = ""


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
    weighed = _weigh(_compared_of(whole, groups, grid), grid)
    axes = _axes(whole, groups, grid)
    flights = _flights(whole, rule)
    parts = [_part(n, "flight", w, g) for n, w, g in flights]
    parts += [_part(c.name, "axis", _weigh([c], grid), grid) for c in axes]
    useful = weighed.useful(grid)
    kept = [c for c, p in zip(axes, parts[len(flights) :], strict=True) if _kept(p, useful)]
    found = _conclude(weighed, grid, list(hints), parts, kept)
    if found.outcome is Outcome.NOT_USABLE:
        found = replace(found, why=(*found.why, *useful_alone(parts)))
    elif most := _most(flights, parts):
        found = _not_usable_on_most(most, parts, list(hints))
        useful = most[0][1].useful(most[0][2])
    found = _partly_judged(found, [*lost, *model.unjudged])
    on = f" [judged on {IN_SHORT.get(judged_on, judged_on)}]"
    return Verdict(
        outcome=found.outcome,
        line=found.line + ("" if judged_on == TEST_FLIGHTS else on),
        useful_seconds=useful,
        judged_seconds=float(grid.seconds[-1]),
        judged_on=judged_on,
        flights=tuple(model.flights),
        groups=tuple(_skill(c, grid) for c in weighed.compared),
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


_Flight = tuple[str, "_Weighed", "_Grid"]
"""Name of a flight, and its errors alone."""


def _compared_of(tables: _Tables, groups: Iterable[str], grid: _Grid) -> list[_Comparison]:
    """The groups, each as a whole."""
    model, last = tables.model, tables.last
    return [
        _compare(model.kinds[g], model.groups[g], last.groups[g], tables.floor_of(g), grid)
        for g in groups
    ]


def _axes(tables: _Tables, groups: Iterable[str], grid: _Grid) -> list[_Comparison]:
    """Every axis of the groups, over all flights."""
    out = []
    for g in groups:
        kind, floor = tables.model.kinds[g], tables.floor_of(g)
        own, held = tables.model.groups[g].axes, tables.last.groups[g].axes
        best = () if floor is None else floor.axes
        for i, name in enumerate(kind.axes if len(own) == len(held) else ()):
            if i < len(own):
                there = best[i] if i < len(best) else None
                out.append(_compare(kind, own[i], held[i], there, grid, name=name))
    return out


def _flights(tables: _Tables, rule: Standard) -> list[_Flight]:
    """Every flight alone, where there are several; those that are too short to tell an error from
    chance are left out."""
    names = list(tables.model.flights)
    out: list[_Flight] = []
    for name in names if len(names) > 1 else ():
        one = tables.of(name)
        if all(len(e.block_sums) < 2 for e in one.model.groups.values()):
            continue
        try:
            groups, grid = _judged(one.model, one.last, rule)
        except DataError:  # too short to judge by
            continue
        out.append((name, _weigh(_compared_of(one, groups, grid), grid), grid))
    return out


def _part(name: str, kind: Literal["flight", "axis"], weighed: _Weighed, grid: _Grid) -> Part:
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


def _most(flights: Sequence[_Flight], parts: Sequence[Part]) -> list[_Flight]:
    """The flights on which the model is not usable alone, the worst first, where they are more than
    half of those that can be judged: what holds on the others does not make it usable."""
    own = {p.name: p for p in parts if p.kind == "flight"}
    judged = [p for p in own.values() if p.outcome is not Outcome.TOO_CALM]
    bad = [f for f in flights if own[f[0]].outcome is Outcome.NOT_USABLE]
    return sorted(bad, key=lambda f: f[1].ends) if 2 * len(bad) > len(judged) else []


def _not_usable_on_most(
    most: Sequence[_Flight], parts: Sequence[Part], hints: list[Hint]
) -> _Finding:
    """What the worst flight says, and how many say so."""
    name, weighed, grid = most[0]
    found = _not_usable(weighed, grid, hints)
    judged = [p for p in parts if p.kind == "flight" and p.outcome is not Outcome.TOO_CALM]
    line = f"NOT USABLE on {len(most)} of {len(judged)} flights alone"
    worst = f"as on {name}: {found.line.removeprefix('NOT USABLE: ')}"
    return replace(found, line=line, why=(worst, *found.why, *useful_alone(parts)))


def _judged(
    model: HorizonTable, last_value: HorizonTable, rule: Standard
) -> tuple[list[str], _Grid]:
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
        at = _index(seconds, rule.look_ahead_imu if imu_only else rule.look_ahead)
        there = [g for g in groups if counts[g][at]]
        if there == groups:
            return groups, _Grid(seconds=seconds, at=at, rule=rule)
        groups = there


def _compare(
    kind: Group,
    model: GroupErrors,
    last: GroupErrors,
    floor: GroupErrors | None,
    grid: _Grid,
    *,
    name: str = "",
) -> _Comparison:
    """One group, or the axis of it that is called `name`."""
    seconds, at, rule = grid.seconds, grid.at, grid.rule
    steps = len(seconds)
    own, held = model.mae[:steps], last.mae[:steps]
    best = None if floor is None or len(floor.mae) < steps else floor.mae[:steps]
    short = seconds <= rule.short + 1e-9
    rival = np.where(short, np.fmax.accumulate(held), held)
    if kind.name == "specific_force" and not kind.own:
        rival[short] = np.maximum(rival, held[_index(seconds, rule.short)])[short]
    elif best is not None:
        short &= np.isfinite(best)
        rival[short] = np.maximum(rival, np.minimum(best, rule.unfair * held))[short]
    chance = np.minimum(standard_error(model, last, steps), rule.noise * held)
    # A sample that is missing at a horizon (references sampled more slowly) says nothing.
    known = np.isfinite(held) & ~np.isnan(own)
    worse = known & ~(own <= rival + rule.equal * held + np.where(np.isfinite(chance), chance, 0.0))
    scale = 0.0 if kind.own else CALM[kind.name] / math.sqrt(len(kind.axes) if name else 1)
    if seconds[0] <= rule.sensor_sample:
        scale = max(scale, rule.noise_motion * float(held[0]))
    calm = bool(held[at] < scale)
    excused = calm and bool(np.nanmax(own[: at + 1]) <= 2.0 * scale)
    return _Comparison(
        name=name or kind.name,
        kind=kind,
        model=own,
        last=held,
        floor=best,
        worse=worse,
        calm=calm,
        excused=excused,
    )


def standard_error(model: GroupErrors, last: GroupErrors, steps: int) -> FloatArray:
    """Standard error (steps,) of the difference between the two mean errors, from blocks of
    consecutive origins.

    Ratio estimator over blocks of unequal size (W. G. Cochran, "Sampling Techniques", 1977, section
    6.3). NaN where fewer than two blocks are there or an error is not finite.
    """
    out = np.full(steps, np.nan)
    if len(model.block_sums) != len(last.block_sums) or len(model.block_sums) < 2:
        return out
    counts = model.block_counts[:, :steps]
    with np.errstate(invalid="ignore"):
        difference = model.block_sums[:, :steps] - last.block_sums[:, :steps]
        total, used = counts.sum(axis=0), (counts > 0).sum(axis=0)
        safe = np.maximum(total, 1.0)
        left = difference - difference.sum(axis=0) / safe * counts
        variance = used / np.maximum(used - 1, 1) * (left * left).sum(axis=0) / safe**2
        out[:] = np.where(used > 1, np.sqrt(variance), np.nan)
    return out


def _index(seconds: FloatArray, wanted: float) -> int:
    """The horizon nearest to `wanted` [s]."""
    return int(np.argmin(np.abs(seconds - wanted)))


def _weigh(compared: Sequence[_Comparison], grid: _Grid) -> _Weighed:
    at, rule = grid.at, grid.rule
    excused = [c for c in compared if c.excused and c.worse[: at + 1].any()]
    counted = [c for c in compared if c not in excused]
    bad = (
        np.any([c.worse for c in counted], axis=0)
        if counted
        else np.zeros(len(grid.seconds), dtype=bool)
    )
    usual = [[c for c in counted if c.kind.name in kind and not c.kind.own] for kind in KINDS]
    together = [*usual, *([c] for c in counted if c.kind.own)]
    return _Weighed(
        compared=compared,
        counted=counted,
        excused=excused,
        idle=[c for kind in together for c in _no_better(kind, slice(grid.first, at + 1), rule)],
        # NaN: nothing to compare
        wrecked=[c for c in counted if c.model[at] > rule.wrecked * c.last[at]],
        ends=int(np.argmax(bad)) if bad.any() else len(grid.seconds),
    )


def _conclude(
    weighed: _Weighed,
    grid: _Grid,
    hints: list[Hint],
    parts: Sequence[Part],
    axes: Sequence[_Comparison],
) -> _Finding:
    if weighed.lost(grid) or any(not c.calm for c in weighed.idle):
        return _not_usable(weighed, grid, hints)
    if weighed.excused or weighed.idle:
        return _too_calm(weighed, grid, parts)
    seconds = weighed.useful(grid)
    claim = _claim([*weighed.counted, *axes], (grid.seconds > grid.rule.short)[: weighed.ends])
    if denied(parts, seconds):
        claim = f"taken together, {claim}"
    skill = (_compared(_skill(c, grid)) for c in weighed.compared)
    return _Finding(
        outcome=Outcome.USABLE,
        line=f"{_useful(weighed, grid)}{in_brackets(parts, seconds)}",
        why=(*reservations(parts, seconds), claim, *skill),
    )


def _not_usable(weighed: _Weighed, grid: _Grid, hints: list[Hint]) -> _Finding:
    """What the worst group points to, among what else was seen."""
    at = grid.at
    if weighed.ends <= grid.first:
        worst = min(
            (c for c in weighed.counted if c.worse.any()), key=lambda c: int(np.argmax(c.worse))
        )
    elif weighed.wrecked:
        worst = max(weighed.wrecked, key=lambda c: float(c.model[at] / c.last[at]))
    else:
        worst = next(c for c in weighed.idle if not c.calm)
    if np.isinf(worst.model[: at + 1]).any():
        hints = [*hints, Hint(symptom=Symptom.DIVERGED)]
    if _starts_off(worst, grid):
        hints = [*hints, Hint(symptom=Symptom.START)]
    lost = weighed.lost(grid)
    reason, action, anchor = likely(hints, _symptom(worst.kind, lost))
    return _Finding(
        outcome=Outcome.NOT_USABLE,
        line=f"NOT USABLE: {_failure(worst, lost, grid)}",
        why=(_size(worst, grid), f"likely: {reason}", f"next: {action} ({anchor})"),
        reason=reason,
        action=action,
        anchor=anchor,
    )


def _starts_off(worst: _Comparison, grid: _Grid) -> bool:
    """Whether dead reckoning, which knows all forces, loses to the last value too before the model
    does, or where it does: what the two share is the start and the reference."""
    if worst.floor is None or not worst.worse.any():
        return False
    until = slice(int(np.argmax(worst.worse)) + 1)
    with np.errstate(invalid="ignore"):
        lost = worst.floor[until] > (1.0 + grid.rule.equal) * worst.last[until]
    return bool(lost.any())


def _too_calm(weighed: _Weighed, grid: _Grid, parts: Sequence[Part]) -> _Finding:
    """Groups that hardly move in these flights, and the flight that would tell."""
    which = [c for c in weighed.compared if c in weighed.excused or c in weighed.idle]
    names = _listed([_word(c.name) for c in which])
    action = f"judge on a flight with {TELLING[which[0].name]}"
    anchor = Symptom.CALM.anchor
    moved = ", ".join(f"{_word(c.name)} {_value(c.last[grid.at], c.kind)}" for c in which)
    line, denying = f"too calm to judge {names}", list[str]()
    if len(which) < len(weighed.compared):
        rest, seconds = (
            [p for p in parts if p.outcome is not Outcome.TOO_CALM],
            weighed.useful(grid),
        )
        line += f"; the rest is {_useful(weighed, grid)}{in_brackets(rest, seconds)}"
        denying = reservations(rest, seconds)
    return _Finding(
        outcome=Outcome.TOO_CALM,
        line=line,
        why=(
            *denying,
            f"within {grid.ahead:.2g} s the flights change by {moved}, where holding the last value "
            "is nearly right",
            f"next: {action} ({anchor})",
        ),
        reason=f"the flights hardly move in {names}",
        action=action,
        anchor=anchor,
    )


def _partly_judged(found: _Finding, unjudged: Sequence[str]) -> _Finding:
    """The finding, with the groups that were measured and have no errors."""
    if not unjudged:
        return found
    said = f"{_listed(list(map(_word, unjudged)))} could not be judged: too many samples missing"
    if found.outcome is not Outcome.USABLE:
        return replace(found, why=(said, *found.why))
    action, anchor = "greybox check names the gaps", Symptom.LOG_FAULT.anchor
    return _Finding(
        outcome=Outcome.PARTLY_JUDGED,
        line=f"{said}; the rest is {found.line}",
        why=(f"next: {action} ({anchor})", *found.why),
        reason=said,
        action=action,
        anchor=anchor,
    )


def _skill(c: _Comparison, grid: _Grid) -> GroupSkill:
    seconds, at = grid.seconds, grid.at
    floor = None if c.floor is None or not np.isfinite(c.floor[at]) else float(c.floor[at])
    distance = float(c.last[at]) - (floor or 0.0)
    gained = float(c.last[at] - c.model[at])
    covered = gained / distance if distance > 0 else -math.inf if gained < 0 else 1.0
    return GroupSkill(
        name=c.name,
        unit=c.kind.unit,
        seconds=float(seconds[at]),
        error=float(c.model[at]),
        last_value=float(c.last[at]),
        measured_imu=floor,
        covered=covered,
        worse_from=float(seconds[int(np.argmax(c.worse))]) if c.worse.any() else None,
        calm=c.calm,
    )


def _useful(weighed: _Weighed, grid: _Grid) -> str:
    more = " and more" if weighed.ends == len(grid.seconds) else ""
    return f"useful for {weighed.useful(grid):.2g} s{more}"


def _claim(counted: Sequence[_Comparison], late: BoolArray) -> str:
    """What holds up to the end of use, at the horizons that are `late` enough: below the last
    value, or not above it by more than chance."""
    with np.errstate(invalid="ignore"):
        above = [c for c in counted if (c.model[: len(late)] > c.last[: len(late)])[late].any()]
    # A group says it of its axes.
    groups = {c.kind.name for c in above if c.name == c.kind.name}
    names = [c.name for c in above if c.name == c.kind.name or c.kind.name not in groups]
    if not names:
        return "errors stay below holding the last value"
    return (
        "no error is above holding the last value by more than chance "
        f"({' and '.join(map(_word, names))}: level with it)"
    )


def _listed(names: Sequence[str]) -> str:
    """a, b and c."""
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def _word(group: str) -> str:
    return group.replace("_", " ")


def _value(value: float, kind: Group) -> str:
    unit, factor = in_degrees(kind.unit)
    return f"{factor * value:.2g} {unit}"


def _symptom(kind: Group, lost: bool) -> Symptom:
    """What a model that is not usable lacks, as far as its worst group says."""
    if kind.own:
        return Symptom.OWN_OUTPUT
    return symptom_of_group(kind.name) if lost else Symptom.NO_BETTER


def _compared(g: GroupSkill) -> str:
    unit, factor = in_degrees(g.unit)
    floor = "" if g.measured_imu is None else f", measured IMU {factor * g.measured_imu:.2g}"
    return (
        f"{g.seconds:.2g} s ahead {_word(g.name)} {factor * g.error:.2g} {unit} (last value "
        f"{factor * g.last_value:.2g}{floor})"
    )


def _no_better(kind: Sequence[_Comparison], span: slice, rule: Standard) -> list[_Comparison]:
    """The groups of a kind that together come nowhere in `span` clearly below the last value."""
    if not kind:
        return []
    ratio = np.array([c.model[span] / np.maximum(c.last[span], 1e-300) for c in kind])
    known = ratio[:, np.isfinite(ratio).all(axis=0)]
    best = (
        float(np.exp(np.log(np.maximum(known, 1e-300)).mean(axis=0)).min())
        if known.size
        else np.inf
    )
    return [] if best < rule.better else list(kind)


def _failure(worst: _Comparison, lost: bool, grid: _Grid) -> str:
    if not lost:
        return f"{_word(worst.name)} is no better than holding the last value"
    when = _when(worst, grid.seconds, grid.at)
    return f"{_word(worst.name)} is worse than holding the last value {when}"


def _size(worst: _Comparison, grid: _Grid) -> str:
    """The error where skill is stated."""
    at = grid.at
    own = _value(worst.model[at], worst.kind) if np.isfinite(worst.model[at]) else "is not finite"
    last = _value(worst.last[at], worst.kind).split()[0]
    return f"{grid.ahead:.2g} s ahead {_word(worst.name)} {own} (last value {last})"


def _when(worst: _Comparison, seconds: FloatArray, at: int) -> str:
    """The horizons at which the last value is better: from the first one on where that holds as far
    as skill is stated, else the first stretch of them."""
    first = int(np.argmax(worst.worse))
    start, better = seconds[first], np.flatnonzero(~worst.worse[first:])
    if not better.size or first + better[0] > at:
        return f"from {start:.2g} s on"
    last = seconds[first + int(better[0]) - 1]
    return f"at {start:.2g} s" if last == start else f"from {start:.2g} to {last:.2g} s"


def in_words(verdict: Verdict) -> list[str]:
    """One plain sentence per group: how much of the way from the last value to the measured IMU the
    model covers; then the flights and axes that deny the verdict alone."""
    lines = []
    for g in verdict.groups:
        aim = "no error at all" if g.measured_imu is None else "the measured IMU"
        if math.isnan(g.error):
            said = "nothing was measured there"
        elif not math.isfinite(g.error):
            said = "predictions are not finite"
        elif g.covered < 0:
            better = "no better" if g.worse_from is None else "worse"
            said = f"{better} than holding the last value"
        else:
            said = f"{100 * min(g.covered, 1.0):.0f} % of the way from the last value to {aim}"
        calm = "; the flights hardly move in it" if g.calm else ""
        worse = (
            ""
            if g.worse_from is None
            else f"; the last value is first better {g.worse_from:.2g} s ahead"
        )
        lines.append(f"{_word(g.name)} {g.seconds:.2g} s ahead: {said}{worse}{calm}")
    return [*lines, *in_sentences(verdict)]
