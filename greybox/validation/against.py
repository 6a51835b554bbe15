"""Against: a model beside the one that it was made of, on the same instants of the same flights.

What differs counts where it is more than chance and worth something: more than a trace, and one
sample ahead, where errors are the sensor's own, in squares more than that of a single reading, as a
name has to remove (worth.py). Chance is judged as in `greybox.validation.comparison`, by blocks of
consecutive origins, with the quantile of Student for as many, one side, and all groups and horizons
together (Bonferroni).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypedDict

import numpy as np

from greybox.errors import DataError
from greybox.model.verdict import Outcome, Verdict
from greybox.shown import in_degrees
from greybox.statistics.distributions import student_quantile
from greybox.validation.advice import Hint, Symptom, likely
from greybox.validation.comparison import standard_error
from greybox.validation.horizon_table import HorizonTable
from greybox.validation.result import Validation
from greybox.validation.usefulness import TEST_FLIGHTS

TRACE = 0.02
"""Share of the squared error below which a difference is worth nothing: one per cent of the error
itself, which no flight controller feels."""
CHANCE = 0.05
"""Probability that two models that are as good pass for clearly different one way, in any group and
horizon."""


class ChangeRow(TypedDict):
    """A `Change` in a result file; an error that is not finite is None."""

    group: str
    unit: str
    seconds: float
    before: float | None
    after: float | None
    clear: bool


class AgainstDocument(TypedDict):
    """An `Against` in a result file."""

    says: str
    line: str
    changes: list[ChangeRow]


@dataclass(frozen=True, kw_only=True)
class Change:
    """Mean errors of the vector norm [unit] of one group, `seconds` ahead, of the model `before`
    and `after`; `level`: they differ by what is worth nothing; `clear`: by more than that and than
    chance."""

    group: str
    unit: str
    seconds: float
    before: float
    after: float
    clear: bool
    level: bool = False

    @property
    def worse(self) -> bool:
        """Whether it is clearly worse."""
        return self.clear and self.after > self.before

    @property
    def numbers(self) -> str:
        """The group, and both errors."""
        unit, factor = in_degrees(self.unit)
        both = f"{factor * self.before:.3g} -> {factor * self.after:.3g}"
        return f"{self.group.replace('_', ' ')} {both} {unit}"

    def to_dict(self) -> ChangeRow:
        """Plain values under the names of the fields."""
        before, after = (e if np.isfinite(e) else None for e in (self.before, self.after))
        return {
            "group": self.group,
            "unit": self.unit,
            "seconds": self.seconds,
            "before": before,
            "after": after,
            "clear": self.clear,
        }


@dataclass(frozen=True, kw_only=True)
class Against:
    """All `changes` from one model to the other by group and horizon, and at which horizon [s] a
    line names all groups (`ahead`). `judged_on` and `flights` say what judged."""

    changes: tuple[Change, ...]
    ahead: float
    judged_on: str
    flights: tuple[str, ...]

    @property
    def worse(self) -> tuple[Change, ...]:
        """Where the second model is clearly worse: of each group the horizon with the largest
        ratio."""
        return _strongest(c for c in self.changes if c.worse)

    @property
    def better(self) -> tuple[Change, ...]:
        """The same where it is clearly better."""
        return _strongest(c for c in self.changes if c.clear and not c.worse)

    @property
    def says(self) -> str:
        """ "worse" (clearly, somewhere), else "better" (clearly, somewhere, on flights that it did
        not see), else "not clear"."""
        if self.worse:
            return "worse"
        return "better" if self.better and self.judged_on == TEST_FLIGHTS else "not clear"

    @property
    def unclear(self) -> tuple[Change, ...]:
        """Of all that differs without being clear the largest rise, and the largest fall."""
        left = [c for c in self.changes if not c.clear and np.isfinite([c.before, c.after]).all()]
        left = [c for c in left if not c.level]
        rises = _strongest(c for c in left if c.after > c.before)
        falls = _strongest(c for c in left if c.after < c.before)
        return (*rises[:1], *falls[:1])

    def line(self, other: str) -> str:
        """One line for people: how the model compares with `other`, at `ahead` in all groups; where
        it is clearly better or worse most, and what may be chance."""
        learned = "not known to be better, on flights that it has not learned from,"
        level = learned if self.better else "not clearly better or worse"
        says = level if self.says == "not clear" else self.says
        all_groups = ", ".join(c.numbers for c in self.changes if c.seconds == self.ahead)
        most = _with_seconds(c for c in self.better if c.seconds != self.ahead)
        worst, unclear = _with_seconds(self.worse), _with_seconds(self.unclear)
        parts = (
            f"{says} than {other}: {self.ahead:.2g} s ahead {all_groups}",
            f"most {most}" if self.says == "better" and most else "",
            f"worst {worst}" if worst else "",
            f"may be chance: {unclear}" if unclear else "",
        )
        on = "" if self.judged_on == TEST_FLIGHTS else f" [judged on {self.judged_on}]"
        return "; ".join(p for p in parts if p) + on

    def to_dict(self, other: str) -> AgainstDocument:
        """Plain values, with the line against `other`."""
        changes = [c.to_dict() for c in self.changes]
        return {"says": self.says, "line": self.line(other), "changes": changes}

    def judged(self, verdict: Verdict, base: str) -> Verdict:
        """The `verdict` of the second model; not usable where it is worse than the first, whose
        file is `base`."""
        if not self.worse or verdict.refused:
            return verdict
        where = _with_seconds(self.worse)
        hint = Hint(symptom=Symptom.LEARNED_WORSE)
        reason, action, anchor = likely([hint], Symptom.LEARNED_WORSE)
        action = f"use the physics model: {base}; then {action}"
        line = (
            f"NOT USABLE: worse than the physics alone on {', '.join(self.flights)}: {where}. "
            f"Likely: {reason}; next: {action} ({anchor})"
        )
        return replace(
            verdict,
            outcome=Outcome.NOT_USABLE,
            line=line,
            reason=reason,
            action=action,
            anchor=anchor,
        )


def _with_seconds(changes: Iterable[Change]) -> str:
    return ", ".join(f"{c.numbers} {c.seconds:.2g} s ahead" for c in changes)


def _level(before: float, after: float, reading: float) -> bool:
    """Whether the difference of two mean errors is worth nothing, where `reading` is the mean
    squared error of one."""
    if not np.isfinite([before, after]).all():
        return before == after
    return abs(after**2 - before**2) <= max(TRACE * before**2, reading)


def _strongest(changes: Iterable[Change]) -> tuple[Change, ...]:
    """Of each group the change with the largest ratio, the largest first."""
    found: dict[str, Change] = {}
    for c in sorted(changes, key=lambda c: min(c.before, c.after) / max(c.before, c.after)):
        found.setdefault(c.group, c)
    return tuple(found.values())


def against(
    before: Validation, after: Validation, readings: Mapping[str, float] | None = None
) -> Against:
    """How the errors of two models differ that were validated on the same flights in the same way,
    at the horizons that are listed and at that where skill is stated. `readings`: group -> mean
    squared error of one reading of its sensor, which counts one sample ahead.

    Raises `DataError` where they were not, or one of them has no verdict.
    """
    old, new = before.table, after.table
    if old is None or new is None or before.verdict is None or after.verdict is None:
        raise DataError("two models can be compared once both are judged")
    if list(before.flights) != list(after.flights) or before.horizons != after.horizons:
        raise DataError(
            "two models are compared on the same flights and horizons",
            expected=", ".join(f["name"] for f in before.flights),
            got=", ".join(f["name"] for f in after.flights),
        )
    ahead = after.verdict.groups[0].seconds
    steps = sorted({*after.horizons, round(ahead / after.sample_time)})
    return Against(
        changes=_changes(old, new, steps, ahead, readings or {}),
        ahead=_shown(ahead),
        judged_on=after.verdict.judged_on,
        flights=after.verdict.flights,
    )


def _changes(
    old: HorizonTable,
    new: HorizonTable,
    steps: Sequence[int],
    ahead: float,
    readings: Mapping[str, float],
) -> tuple[Change, ...]:
    """Of every group and horizon that both have."""
    groups = [g for g in new.groups if g in old.groups]
    share = CHANCE / max(1, len(groups) * len(steps))
    out = []
    for g in groups:
        a, b = old.groups[g], new.groups[g]
        deviation = standard_error(b, a, len(b.mae))
        blocks = (b.block_counts > 0).sum(axis=0)
        for h in steps:
            i = h - 1
            before, after = float(a.mae[i]), float(b.mae[i])
            if np.isnan(before) or np.isnan(after):
                continue
            chance = np.inf
            if blocks[i] > 1:
                chance = float(student_quantile(1 - share, blocks[i] - 1)) * deviation[i]
            level = _level(before, after, readings.get(g, 0.0) if h == 1 else 0.0)
            seconds = ahead if h == round(ahead / new.sample_time) else h * new.sample_time
            out.append(
                Change(
                    group=g,
                    unit=new.kinds[g].unit,
                    seconds=_shown(seconds),
                    before=before,
                    after=after,
                    clear=not level and _beyond(before, after, chance),
                    level=level,
                )
            )
    return tuple(out)


def _shown(seconds: float) -> float:
    """Without the last digits, which steps of a time stamp that was rounded differ by."""
    return float(f"{seconds:.9g}")


def _beyond(before: float, after: float, chance: float) -> bool:
    """Whether two mean errors differ by more than `chance`; a prediction that diverged does."""
    return not np.isfinite([before, after]).all() or abs(after - before) > chance
