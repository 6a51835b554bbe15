"""Verdict: what judging a model on flights said, as it stays with the model, its files and reports.

The record holds what was found and the words for it; `greybox.validation.usefulness` makes it. It
lives here because a model file carries it.
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass, replace
from typing import Literal, NotRequired, Protocol, TypedDict

from greybox.errors import ModelError
from greybox.files import Parsed

NOT_JUDGED = (
    "NOT JUDGED: this model was not compared with holding the last value; `greybox validate` does"
)
"""First line of a model without a verdict (one of an older file, or one that was changed since)."""


class Outcome(enum.Enum):
    """What a verdict says. The value is what files hold."""

    USABLE = "usable"
    NOT_USABLE = "not usable"
    TOO_CALM = "too calm"
    PARTLY_JUDGED = "partly judged"
    UNFINISHED = "unfinished"


class GroupSkillRow(TypedDict):
    """A `GroupSkill` in a file."""

    name: str
    unit: str
    seconds: float
    error: float | None
    last_value: float | None
    measured_imu: float | None
    covered: float | None
    worse_from: float | None
    calm: bool


class PartRow(TypedDict):
    """A `Part` in a file."""

    name: str
    kind: Literal["flight", "axis"]
    outcome: str
    useful_seconds: float
    groups: list[str]
    worse_from: float | None


class VerdictDocument(TypedDict):
    """A `Verdict` in a file."""

    outcome: str
    line: str
    useful_seconds: float
    judged_seconds: float
    judged_on: str
    flights: list[str]
    groups: list[GroupSkillRow]
    reason: str
    action: str
    anchor: str
    why: NotRequired[list[str]]
    parts: NotRequired[list[PartRow]]


@dataclass(frozen=True, kw_only=True)
class Part:
    """One flight, or one axis of a group over all flights, judged alone.

    `outcome` and `useful_seconds` as in `Verdict`; `groups` are those that end the use, or move too
    little to judge, with the first horizon at which the last value is better, `worse_from` [s]
    (None where there is none).
    """

    name: str
    kind: Literal["flight", "axis"]
    outcome: Outcome
    useful_seconds: float
    groups: tuple[str, ...] = ()
    worse_from: float | None = None

    def to_dict(self) -> PartRow:
        """Plain values under the names of the fields."""
        return {
            "name": self.name,
            "kind": self.kind,
            "outcome": self.outcome.value,
            "useful_seconds": self.useful_seconds,
            "groups": list(self.groups),
            "worse_from": self.worse_from,
        }


@dataclass(frozen=True, kw_only=True)
class GroupSkill:
    """One channel group at `seconds` ahead: error of the model, of holding the last value, of dead
    reckoning.

    Mean absolute errors in `unit`; `measured_imu` is None where there is no dead reckoning.
    `covered` is the share of the distance between holding the last value and dead reckoning (or no
    error at all, where there is none) that the model covers: 1 = as good as the measured IMU, 0 =
    as the last value, below 0 worse. `worse_from` [s] is the first horizon at which the last value
    is better, None where there is none; `calm`: the flights hardly move in this group.
    """

    name: str
    unit: str
    seconds: float
    error: float
    last_value: float
    measured_imu: float | None
    covered: float
    worse_from: float | None
    calm: bool

    def to_dict(self) -> GroupSkillRow:
        """Plain values under the names of the fields; null for a number that is not finite."""
        return {
            "name": self.name,
            "unit": self.unit,
            "seconds": self.seconds,
            "error": _finite(self.error),
            "last_value": _finite(self.last_value),
            "measured_imu": _finite(self.measured_imu),
            "covered": _finite(self.covered),
            "worse_from": _finite(self.worse_from),
            "calm": self.calm,
        }


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """Whether a model is usable, and the one line that says so.

    `line` is the first line of every output, `why` what stands below it: what denies it, what holds
    it up and what to do, the most important first; () in an older file. `useful_seconds` [s]: up to
    there no group that could be judged is worse than holding the last value; judging ended at
    `judged_seconds`. `judged_on` says in words which flights judged (`flights` by name). `reason`,
    `action` and `anchor` (a section of docs/bad_fit.md) are empty where nothing is wrong. `parts`
    are every flight, where there are several, and every axis, judged alone; () in an older file.
    """

    outcome: Outcome
    line: str
    useful_seconds: float
    judged_seconds: float
    judged_on: str
    flights: tuple[str, ...]
    groups: tuple[GroupSkill, ...]
    reason: str = ""
    action: str = ""
    anchor: str = ""
    why: tuple[str, ...] = ()
    parts: tuple[Part, ...] = ()

    def lines(self) -> list[str]:
        """The first line, and indented below it the reasons."""
        return [self.line, *(f"  {reason}" for reason in self.why)]

    @property
    def sentence(self) -> str:
        """In one line, as errors are told: of a model that is refused all, else the first line."""
        return "; ".join([self.line, *self.why]) if self.refused else self.line

    @property
    def refused(self) -> bool:
        """Whether whoever builds on the model has to be asked: not usable, or unfinished."""
        return self.outcome in (Outcome.NOT_USABLE, Outcome.UNFINISHED)

    @property
    def exit_code(self) -> int:
        """0 usable, partly judged or too calm to tell, 1 not usable."""
        return 1 if self.refused else 0

    def to_dict(self) -> VerdictDocument:
        """Plain values under the names of the fields; null for a number that is not finite."""
        return {
            "outcome": self.outcome.value,
            "line": self.line,
            "useful_seconds": self.useful_seconds,
            "judged_seconds": self.judged_seconds,
            "judged_on": self.judged_on,
            "flights": list(self.flights),
            "groups": [g.to_dict() for g in self.groups],
            "reason": self.reason,
            "action": self.action,
            "anchor": self.anchor,
            "why": list(self.why),
            "parts": [p.to_dict() for p in self.parts],
        }

    @staticmethod
    def from_dict(data: Parsed) -> Verdict:
        """The verdict of a file. Raises `KeyError`, `TypeError` or `ValueError` for one that is
        incomplete."""
        return Verdict(
            outcome=Outcome(data["outcome"]),
            line=str(data["line"]),
            useful_seconds=float(data["useful_seconds"]),
            judged_seconds=float(data["judged_seconds"]),
            judged_on=str(data["judged_on"]),
            flights=tuple(str(f) for f in data["flights"]),
            groups=tuple(
                GroupSkill(
                    name=str(g["name"]),
                    unit=str(g["unit"]),
                    seconds=float(g["seconds"]),
                    error=_number(g["error"]),
                    last_value=_number(g["last_value"]),
                    measured_imu=None if g["measured_imu"] is None else float(g["measured_imu"]),
                    covered=_number(g["covered"], -1),
                    worse_from=None if g["worse_from"] is None else float(g["worse_from"]),
                    calm=bool(g["calm"]),
                )
                for g in data["groups"]
            ),
            reason=str(data["reason"]),
            action=str(data["action"]),
            anchor=str(data["anchor"]),
            why=tuple(str(w) for w in data.get("why", ())),
            parts=tuple(
                Part(
                    name=str(p["name"]),
                    kind="flight" if p["kind"] == "flight" else "axis",
                    outcome=Outcome(p["outcome"]),
                    useful_seconds=float(p["useful_seconds"]),
                    groups=tuple(str(g) for g in p["groups"]),
                    worse_from=None if p["worse_from"] is None else float(p["worse_from"]),
                )
                for p in data.get("parts", ())
            ),
        )


def _number(value: float | None, sign: int = 1) -> float:
    """A number of a file, where an infinite one (predictions that diverged) is written as null."""
    return sign * float("inf") if value is None else float(value)


UNFINISHED = Verdict(
    outcome=Outcome.UNFINISHED,
    line="UNFINISHED: the command that fitted this model ended before the model was judged",
    why=(
        "its errors are not whole, its predictions not calibrated",
        "next: the same command goes on",
    ),
    useful_seconds=0.0,
    judged_seconds=0.0,
    judged_on="",
    flights=(),
    groups=(),
)
"""What a fit is saved with while the rest is at work, so that nothing can lose it."""
STOPPED = replace(
    UNFINISHED,
    line="UNFINISHED: the search stopped on the way to this model; discovery.json says how",
)
"""Of the model of a search that goes on."""


def demand_usable(verdict: Verdict | None, model: str, *, even_so: bool) -> None:
    """Raises `ModelError` where flights judged the `model` (its name) not usable and nobody said
    `even_so`. A model that was not judged passes."""
    if verdict is not None and verdict.refused and not even_so:
        raise ModelError(verdict.sentence, where=model, fix="even_so=True goes on all the same")


class Judged(Protocol):
    """What carries a verdict, and has a name."""

    @property
    def name(self) -> str:
        """As its file says."""
        ...

    @property
    def verdict(self) -> Verdict | None:
        """None where nobody judged."""
        ...


def demand_finished(model: Judged | None) -> None:
    """Raises `ModelError` for the model of a command that ended before the model was judged:
    whoever builds on it would give it a verdict that is not its own."""
    verdict = None if model is None else model.verdict
    if model is not None and verdict is not None and verdict.outcome is Outcome.UNFINISHED:
        raise ModelError(
            verdict.sentence,
            where=model.name,
            fix="dataclasses.replace(model, verdict=None) goes on all the same",
        )
