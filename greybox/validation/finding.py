"""Finding: what a comparison says of a model, in words.

The first line is the result; below it stands what denies it, what holds it up and what to do.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from greybox.model.verdict import GroupSkill, Outcome, Part, Verdict
from greybox.shown import in_degrees
from greybox.symbolic import BoolArray
from greybox.validation.advice import Hint, Symptom, likely, symptom_of_group
from greybox.validation.comparison import Alone, Comparison, Grid, Weighed
from greybox.validation.groups import Group
from greybox.validation.parts import denied, in_brackets, in_sentences, reservations, useful_alone

TELLING = {
    "position": "figures of eight at 1 m/s",
    "velocity": "figures of eight at 1 m/s",
    "rotation": "fast figures of eight, or steps of 10 deg in roll and pitch",
    "rate": "steps of 10 deg in roll, pitch and yaw",
    "specific_force": "climbs and descents at 1 m/s",
}
"""The flight that would tell, per group."""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """What is concluded, in words; fields as those of `Verdict`."""

    outcome: Outcome
    line: str
    why: tuple[str, ...]
    reason: str = ""
    action: str = ""
    anchor: str = ""


def conclude(
    weighed: Weighed,
    grid: Grid,
    hints: list[Hint],
    parts: Sequence[Part],
    axes: Sequence[Comparison],
) -> Finding:
    """What the groups say that were weighed, on all flights together, with what `parts` deny;
    `axes` are those that take part in the claim."""
    if weighed.lost(grid) or any(not c.calm for c in weighed.idle):
        return not_usable(weighed, grid, hints)
    if weighed.excused or weighed.idle:
        return _too_calm(weighed, grid, parts)
    seconds = weighed.useful(grid)
    claim = _claim([*weighed.counted, *axes], (grid.seconds > grid.rule.short)[: weighed.ends])
    if denied(parts, seconds):
        claim = f"taken together, {claim}"
    skill = (_compared(skill_of(c, grid)) for c in weighed.compared)
    return Finding(
        outcome=Outcome.USABLE,
        line=f"{_useful(weighed, grid)}{in_brackets(parts, seconds)}",
        why=(*reservations(parts, seconds), claim, *skill),
    )


def not_usable(weighed: Weighed, grid: Grid, hints: list[Hint]) -> Finding:
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
    return Finding(
        outcome=Outcome.NOT_USABLE,
        line=f"NOT USABLE: {_failure(worst, lost, grid)}",
        why=(_size(worst, grid), f"likely: {reason}", f"next: {action} ({anchor})"),
        reason=reason,
        action=action,
        anchor=anchor,
    )


def not_usable_on_most(most: Sequence[Alone], parts: Sequence[Part], hints: list[Hint]) -> Finding:
    """What the worst flight says, and how many say so."""
    name, weighed, grid = most[0]
    found = not_usable(weighed, grid, hints)
    judged = [p for p in parts if p.kind == "flight" and p.outcome is not Outcome.TOO_CALM]
    line = f"NOT USABLE on {len(most)} of {len(judged)} flights alone"
    worst = f"as on {name}: {found.line.removeprefix('NOT USABLE: ')}"
    return replace(found, line=line, why=(worst, *found.why, *useful_alone(parts)))


def _starts_off(worst: Comparison, grid: Grid) -> bool:
    """Whether dead reckoning, which knows all forces, loses to the last value too before the model
    does, or where it does: what the two share is the start and the reference."""
    if worst.floor is None or not worst.worse.any():
        return False
    until = slice(int(np.argmax(worst.worse)) + 1)
    with np.errstate(invalid="ignore"):
        lost = worst.floor[until] > (1.0 + grid.rule.equal) * worst.last[until]
    return bool(lost.any())


def _too_calm(weighed: Weighed, grid: Grid, parts: Sequence[Part]) -> Finding:
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
    return Finding(
        outcome=Outcome.TOO_CALM,
        line=line,
        why=(
            *denying,
            f"within {grid.ahead:.2g} s the flights change by {moved}, where holding the last "
            "value is nearly right",
            f"next: {action} ({anchor})",
        ),
        reason=f"the flights hardly move in {names}",
        action=action,
        anchor=anchor,
    )


def partly_judged(found: Finding, unjudged: Sequence[str]) -> Finding:
    """The finding, with the groups that were measured and have no errors."""
    if not unjudged:
        return found
    said = f"{_listed(list(map(_word, unjudged)))} could not be judged: too many samples missing"
    if found.outcome is not Outcome.USABLE:
        return replace(found, why=(said, *found.why))
    action, anchor = "greybox check names the gaps", Symptom.LOG_FAULT.anchor
    return Finding(
        outcome=Outcome.PARTLY_JUDGED,
        line=f"{said}; the rest is {found.line}",
        why=(f"next: {action} ({anchor})", *found.why),
        reason=said,
        action=action,
        anchor=anchor,
    )


def skill_of(c: Comparison, grid: Grid) -> GroupSkill:
    """One group where skill is stated."""
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


def _useful(weighed: Weighed, grid: Grid) -> str:
    more = " and more" if weighed.ends == len(grid.seconds) else ""
    return f"useful for {weighed.useful(grid):.2g} s{more}"


def _claim(counted: Sequence[Comparison], late: BoolArray) -> str:
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


def _failure(worst: Comparison, lost: bool, grid: Grid) -> str:
    if not lost:
        return f"{_word(worst.name)} is no better than holding the last value"
    when = _when(worst, grid)
    return f"{_word(worst.name)} is worse than holding the last value {when}"


def _size(worst: Comparison, grid: Grid) -> str:
    """The error where skill is stated."""
    at = grid.at
    own = _value(worst.model[at], worst.kind) if np.isfinite(worst.model[at]) else "is not finite"
    last = _value(worst.last[at], worst.kind).split()[0]
    return f"{grid.ahead:.2g} s ahead {_word(worst.name)} {own} (last value {last})"


def _when(worst: Comparison, grid: Grid) -> str:
    """The horizons at which the last value is better: from the first one on where that holds as far
    as skill is stated, else the first stretch of them."""
    first = int(np.argmax(worst.worse))
    seconds = grid.seconds
    start, better = seconds[first], np.flatnonzero(~worst.worse[first:])
    if not better.size or first + better[0] > grid.at:
        return f"from {start:.2g} s on"
    last = seconds[first + int(better[0]) - 1]
    return f"at {start:.2g} s" if last == start else f"from {start:.2g} to {last:.2g} s"


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


def _listed(names: Sequence[str]) -> str:
    """a, b and c."""
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def _word(group: str) -> str:
    return group.replace("_", " ")


def _value(value: float, kind: Group) -> str:
    unit, factor = in_degrees(kind.unit)
    return f"{factor * value:.2g} {unit}"


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
