"""Findings: what a data-fault check saw, where, with which numbers, and what to do about it."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from greybox.data.checks.view import View
from greybox.files import Json
from greybox.shown import Cell, Shown

Severity = Literal["info", "warning", "blocking"]
SEVERITIES: tuple[Severity, ...] = ("blocking", "warning", "info")

TOGETHER = ("motion", "attitude", "acceleration", "alignment", "motors")
"""Checks that hold one stream against another: without them axes, units and the order of motors may
be wrong."""
SCHEMA = "greybox.check/1"
WANDER = 1.0
"""Samples by which gyro and attitude must drift apart before their clocks count as wandering, and by
which axes must differ before the attitude counts as an estimator's."""
MOST_NAMED = 4
"""Flights that are named where a finding holds for many."""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One observation. `where` names channels, rows or times; `evidence` are numbers with the unit
    in their name.

    "blocking": a fit on this log would be wrong; "warning": it may be; "info": worth knowing.
    """

    check: str
    severity: Severity
    flight: str
    where: str
    message: str
    evidence: Mapping[str, float] = field(default_factory=dict)
    fix: str = ""

    @property
    def said(self) -> str:
        """Check, place and message; messages that begin with the place say it once."""
        begins = self.message.startswith(f"{self.where}: ")
        return f"[{self.check}] {'' if begins else f'{self.where}: '}{self.message}"


@dataclass(frozen=True, kw_only=True)
class Unjudged:
    """A check that could not be made on a flight, and why; `part` is all that is open where the rest
    was judged. `open`: the flight has what the check is about, and does not tell."""

    check: str
    flight: str
    reason: str
    part: str = ""
    open: bool = False


Outcome = Finding | Unjudged


@dataclass(frozen=True, kw_only=True)
class Check:
    """One check: its name, the question it answers, and the function that answers it for the
    flights of a craft."""

    name: str
    question: str
    run: Callable[[Sequence[View]], Iterable[Outcome]]


def per_flight(
    run: Callable[[View], Iterable[Outcome]],
) -> Callable[[Sequence[View]], Iterable[Outcome]]:
    """The check of one flight, made on every flight."""

    def every(views: Sequence[View]) -> Iterable[Outcome]:
        for view in views:
            found = view.found.get(run)
            outcomes = found if isinstance(found, tuple) else tuple(run(view))
            view.keep(run, outcomes)
            yield from outcomes

    return every


@dataclass(frozen=True, kw_only=True)
class FlightSummary:
    """What was checked: rows, time span [s] and rate [Hz] of one log."""

    name: str
    source: str
    sha256: str
    rows: int
    duration: float
    rate: float


@dataclass(frozen=True, kw_only=True, repr=False)
class CheckReport(Shown):
    """All findings of a set of flights, the most severe first, and the checks that could not be
    made.

    `accepted` are the checks whose blocking findings somebody who knows better has overruled.
    """

    vehicle: str
    flights: tuple[FlightSummary, ...]
    findings: tuple[Finding, ...]
    not_judged: tuple[Unjudged, ...]
    accepted: tuple[str, ...] = ()

    @property
    def blocking(self) -> tuple[Finding, ...]:
        """The findings that forbid a fit."""
        return tuple(
            f for f in self.findings if f.severity == "blocking" and f.check not in self.accepted
        )

    @property
    def overruled(self) -> tuple[Finding, ...]:
        """The findings that would forbid a fit had they not been accepted."""
        return tuple(
            f for f in self.findings if f.severity == "blocking" and f.check in self.accepted
        )

    def accepted_lines(self) -> list[str]:
        """What a result says that is made in spite of faults that were accepted."""
        return [f"accepted: {f.flight}: {f.message}" for f in self.overruled]

    @property
    def ok(self) -> bool:
        """Whether nothing forbids a fit."""
        return not self.blocking

    def of(self, check: str, flight: str | None = None) -> tuple[Finding, ...]:
        """The findings of one check (on one flight)."""
        return tuple(f for f in self.findings if f.check == check and flight in (None, f.flight))

    @property
    def drifts(self) -> tuple[float, ...]:
        """How far the clocks of gyro and attitude drift apart [samples], of every flight that shows
        it."""
        seen = [f.evidence for f in self.of("alignment") if "high_samples" in f.evidence]
        return tuple(float(e["high_samples"] - e["low_samples"]) for e in seen)

    @property
    def axes_apart(self) -> tuple[float, ...]:
        """By how much the gyro is later against the attitude about one axis than about another
        [samples], of every flight whose attitude an estimator filters."""
        key = "axes_apart_samples"
        return tuple(float(f.evidence[key]) for f in self.of("alignment") if key in f.evidence)

    @property
    def wander(self) -> float:
        """The median of the `drifts` [samples]; 0 without any."""
        return statistics.median(self.drifts) if self.drifts else 0.0

    @property
    def loose(self) -> bool:
        """Whether the attitude of most flights is not the integral of the gyro: clocks drift apart,
        or an estimator errs about its axes."""
        each = (*self.drifts, *self.axes_apart)
        return bool(each) and statistics.median(each) > WANDER

    def to_dict(self) -> dict[str, Json]:
        """Plain values for the result file, schema "greybox.check/1"."""
        return {
            "schema": SCHEMA,
            "vehicle": self.vehicle,
            "verdict": self.verdict,
            "counts": {s: sum(f.severity == s for f in self.findings) for s in SEVERITIES},
            "flights": [vars(f) for f in self.flights],
            "findings": [{**vars(f), "evidence": dict(f.evidence)} for f in self.findings],
            "not_judged": [
                {"check": u.check, "flight": u.flight, "reason": u.reason} for u in self.not_judged
            ],
            "accepted": list(self.accepted),
        }

    @property
    def verdict(self) -> str:
        """ "blocking", "warnings" or "clean"."""
        if self.blocking:
            return "blocking"
        return "warnings" if any(f.severity != "info" for f in self.findings) else "clean"

    def warning_lines(self) -> list[str]:
        """What a command that goes on must say first, one line per check and place: warnings, and
        what is missing at all. Not excitation, for the errors of what is found tell it."""
        groups: dict[tuple[str, str], list[Finding]] = {}
        for f in self.findings:
            missing = any(name.startswith("missing_share") for name in f.evidence)
            if missing or (f.severity == "warning" and f.check != "excitation"):
                groups.setdefault((f.check, f.where), []).append(f)
        out = []
        for same in groups.values():
            more = " (greybox check lists the others)" if len({f.message for f in same}) > 1 else ""
            out.append(f"{_flights(same)} {same[0].said}{more}")
        return [*out, *self.unchecked_order]

    @property
    def unchecked_order(self) -> list[str]:
        """What a fit cannot see, where no flight of the craft tells it: which command drives which
        rotor."""
        open_ = {u.flight: u.reason for u in self.not_judged if u.check == "motors" and not u.part}
        if not self.flights or len(open_) < len(self.flights):
            return []
        return [
            f"the order of the motors was not checked: {'; '.join(dict.fromkeys(open_.values()))}"
        ]

    def _alike(self) -> list[list[Finding]]:
        """Findings that say the same of several flights, together."""
        groups: dict[tuple[str, ...], list[Finding]] = {}
        for f in self.findings:
            groups.setdefault((f.severity, f.check, f.where, f.message), []).append(f)
        return list(groups.values())

    @property
    def _but(self) -> str:
        """What the verdict is not on, as its end: checks of one stream against another that could
        not be made on some flight."""
        some = dict.fromkeys(u.check for u in self.not_judged if u.check in TOGETHER and not u.part)
        return f" (not judged: {', '.join(some)})" if some else ""

    def _shown_text(self) -> str:
        """The summary."""
        return self.summary()

    def _shown_rows(self) -> list[dict[str, Cell]]:
        """One row per finding."""
        return [
            {
                "severity": f.severity,
                "flight": f.flight,
                "check": f.check,
                "where": f.where,
                "finding": f.message,
                "usual fix": f.fix,
            }
            for f in self.findings
        ]

    def summary(self) -> str:
        """The report as text for a terminal."""
        lines = [f"checked {len(self.flights)} log(s) of {self.vehicle}: {self.verdict}{self._but}"]
        for same in self._alike():
            finding = same[0]
            word = "accepted" if finding in self.overruled else finding.severity
            lines.append(f"{word:8s} {_flights(same)} {finding.said}")
            numbers = ", ".join(f"{k} = {v:.4g}" for k, v in finding.evidence.items())
            if numbers and finding.severity != "info":
                lines.append(f"         {numbers}")
            if finding.fix and finding.severity != "info":
                lines.append(f"         usual fix: {finding.fix}")
        if self.overruled:
            checks = ", ".join(dict.fromkeys(f.check for f in self.overruled))
            lines.append(
                f"accepted all the same: {checks}; whatever is built on these logs carries that"
            )
        reasons: dict[tuple[str, str], int] = {}
        for u in self.not_judged:
            what = f"{u.check}, {u.part}" if u.part else u.check
            reasons[what, u.reason] = reasons.get((what, u.reason), 0) + 1
        for (what, reason), count in reasons.items():
            lines.append(f"cannot be judged: {what} ({reason}; {count} log(s))")
        return "\n".join(lines)


def _flights(same: Sequence[Finding]) -> str:
    """The flights of findings, the first of many."""
    names = ", ".join(f.flight for f in same[:MOST_NAMED])
    more = ", ..." if len(same) > MOST_NAMED else ""
    return names if len(same) == 1 else f"{len(same)} flights ({names}{more})"
