"""The data-fault gate: one check = one file; a fault is reported as a fault before anything is
called physics."""

from __future__ import annotations

import functools
import os
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from greybox.data.airframe import Airframe
from greybox.data.checks import (
    acceleration,
    alignment,
    attitude,
    clock,
    excitation,
    frozen,
    gaps,
    gravity,
    held,
    jumps,
    kinematics,
    motion,
    motors,
    ranges,
    rotor_speeds,
    saturation,
    thrust,
)
from greybox.data.checks.craft import of_the_craft
from greybox.data.checks.finding import (
    SEVERITIES,
    Check,
    CheckReport,
    Finding,
    FlightSummary,
    Severity,
    Unjudged,
)
from greybox.data.checks.rates import shown_by
from greybox.data.checks.view import View
from greybox.data.dataset import Dataset, Flight, demand_names_once
from greybox.data.logs import read_table
from greybox.data.raw import RawLog, measurable
from greybox.data.readers import LogMapping
from greybox.errors import UnknownNameError
from greybox.takes import LOGS, takes
from greybox.takes import NAMES as LIST_OF_NAMES
from greybox.takes import VEHICLE as A_VEHICLE

__all__ = [
    "CHECKS",
    "Check",
    "CheckReport",
    "Checked",
    "Finding",
    "FlightSummary",
    "Severity",
    "Unjudged",
    "check",
    "check_logs",
]

RELATIONS = (motion.RELATION, attitude.RELATION, acceleration.RELATION)
"""What kinematics makes equal, each one file."""

KINEMATICS = Check(
    name="kinematics",
    question="Do position, velocity, attitude, rates and specific force tell the same story?",
    run=functools.partial(kinematics.run, relations=RELATIONS),
)

CHECKS: tuple[Check, ...] = (
    clock.CHECK,
    jumps.CHECK,
    gaps.CHECK,
    frozen.CHECK,
    held.CHECK,
    ranges.CHECK,
    saturation.CHECK,
    gravity.CHECK,
    KINEMATICS,
    alignment.CHECK,
    motors.CHECK,
    rotor_speeds.CHECK,
    thrust.CHECK,
    excitation.CHECK,
)
"""All checks, in the order in which they are made: the motors are judged by rates that are right."""


VEHICLE = "vehicle"
"""What findings on the vehicle file itself are of; commands that refuse such a file add them."""
NAMES = tuple(
    sorted(
        {VEHICLE, *(c.name for c in CHECKS if c is not KINEMATICS), *(r.name for r in RELATIONS)}
    )
)
"""What a finding can be of, and what can be accepted."""


FRAMES = (*(r.name for r in RELATIONS), "alignment", gravity.CHECK.name)
"""Checks that find axes, units or clocks wrong."""
WRONG = "axes, unit or clock of the gyro are wrong, or of the attitude where there is none"
WRONG_FORCE = "the accelerometer's unit or axes are wrong, or the motion's where there is none"


def _of_wrong_rates(findings: Iterable[Finding], views: Iterable[View]) -> set[str]:
    """The flights whose gyro, or attitude where there is none, judges no motors, neither their own
    nor those of the craft."""
    named = {"rate": ("p, q, r",), "attitude": ("p, q, r", "qw"), "": ()}
    by = {v.name: named[shown_by(v)] for v in views}
    return {
        f.flight
        for f in findings
        if f.severity == "blocking"
        and f.check in FRAMES
        and any(n in f.where for n in by[f.flight])
    }


def _of_a_wrong_force(findings: Iterable[Finding], views: Iterable[View]) -> set[str]:
    """The flights whose accelerometer, or motion where there is none, weighs no thrust."""
    felt = {v.name for v in views if v.has("specific_force")}
    return {
        f.flight
        for f in findings
        if f.severity == "blocking"
        and (
            f.check == gravity.CHECK.name and "ax" in f.where
            if f.flight in felt
            else f.check in FRAMES
        )
    }


@takes(data=LOGS, vehicle=A_VEHICLE, accept=LIST_OF_NAMES)
def check(
    data: Dataset | Flight | Sequence[RawLog], vehicle: Airframe, *, accept: Iterable[str] = ()
) -> CheckReport:
    """Look for data faults. Raw logs (`read_table`) show everything; a data set no longer shows
    faults of its clock.

    Blocking findings of the checks named in `accept` do not block; the report keeps them and says
    so. Raises `DataError` where two logs have the same name or one is none (no rows, no channels,
    stamps that are no numbers), and `UnknownNameError` for a check that there is not.
    """
    return Checked.of(data, vehicle).report(accept)


@dataclass(frozen=True, kw_only=True, eq=False)
class Checked:
    """Flights of one craft under check, which are reported alone and beside others: what a flight
    shows by itself is found once where it is `asked_again`."""

    vehicle: Airframe
    views: tuple[View, ...]

    @classmethod
    def of(
        cls,
        data: Dataset | Flight | Sequence[RawLog],
        vehicle: Airframe,
        *,
        asked_again: bool = False,
    ) -> Checked:
        """Raises `DataError` where two logs have the same name or one is none."""
        given = Dataset.of(data) if isinstance(data, Flight) else data
        logs = [f.as_log() if isinstance(f, Flight) else f for f in given]
        demand_names_once([log.flight for log in logs])
        raws = [measurable(log) for log in logs]
        views = tuple(View(raw=r, vehicle=vehicle, asked_again=asked_again) for r in raws)
        return cls(vehicle=vehicle, views=views)

    def report(self, accept: Iterable[str] = (), *, beside: Checked | None = None) -> CheckReport:
        """What is found of these flights where those `beside` them, of the same craft, are looked
        at with them: what they prove of the vehicle file holds for these. Names may be in both.
        `accept` as of `check`. Raises `UnknownNameError`."""
        accepted = tuple(dict.fromkeys(accept))
        for name in accepted:
            if name not in NAMES:
                raise UnknownNameError("check", name, NAMES)
        names = {v.name for v in self.views}
        others = () if beside is None else tuple(_renamed(v, names) for v in beside.views)
        findings, unjudged = _outcomes((*self.views, *others))
        return CheckReport(
            vehicle=self.vehicle.name,
            flights=tuple(_summary(v) for v in self.views),
            findings=tuple(f for f in findings if f.flight in names),
            not_judged=tuple(u for u in unjudged if u.flight in names),
            accepted=accepted,
        )


def _outcomes(views: Sequence[View]) -> tuple[list[Finding], list[Unjudged]]:
    """All findings, the most severe first, and what could not be judged."""
    findings: list[Finding] = []
    unjudged: list[Unjudged] = []
    # What overflows in a check is a value that `ranges` names.
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for one in CHECKS:
            wrong, why = set[str](), WRONG
            if one is motors.CHECK:
                wrong = _of_wrong_rates(findings, views)
            elif one is thrust.CHECK:
                wrong, why = _of_a_wrong_force(findings, views), WRONG_FORCE
            unjudged += [Unjudged(check=one.name, flight=n, reason=why) for n in sorted(wrong)]
            asked = [v for v in views if v.name not in wrong]
            outcomes = list(one.run(asked))
            unjudged += [o for o in outcomes if isinstance(o, Unjudged)]
            told = [o for o in outcomes if isinstance(o, Finding)]
            findings += of_the_craft(told, unjudged, [v.name for v in asked])
    findings.sort(key=lambda f: SEVERITIES.index(f.severity))
    return findings, unjudged


def _summary(view: View) -> FlightSummary:
    log = view.raw
    return FlightSummary(
        name=log.flight,
        source=log.source,
        sha256=log.sha256,
        rows=log.n,
        duration=float(np.max(log.t) - np.min(log.t)),
        rate=view.rate,
    )


def _renamed(view: View, taken: Collection[str]) -> View:
    """The flight under a name that is not taken."""
    name = view.name
    while name in taken:
        name += "'"
    return view if name == view.name else replace(view, raw=replace(view.raw, flight=name))


def check_logs(
    paths: Iterable[str | os.PathLike[str]],
    vehicle: Airframe,
    *,
    mapping: str | os.PathLike[str] | LogMapping | None = None,
    accept: Iterable[str] = (),
) -> CheckReport:
    """Read logs and look for data faults, those of the clock included. Raises what `read_table` and
    `check` raise."""
    return check([read_table(p, vehicle, mapping=mapping) for p in paths], vehicle, accept=accept)
