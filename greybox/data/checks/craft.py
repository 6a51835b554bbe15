"""What some flights prove of the vehicle file holds for the flights that cannot tell.

Order, spins, scales and frames stand in one file for all flights. Where one flight proves one of
them wrong and another shows it right, the log of the first is at fault (`together.py`). Where none
shows it right the file is, and a flight too calm to see that would be fitted to it all the same.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import replace

from greybox.data.checks.finding import Finding, Unjudged
from greybox.data.checks.motors import PARTS

MOTORS = "motors"
"""A flight of which this check, or the one that blocks, says anything shows nothing of its right."""
OF_THE_FILE = ("motion", "attitude", "acceleration", MOTORS, "rotor_speeds", "thrust")
"""Checks of what the vehicle file says of all flights. Clocks, gaps and jumps are of one log, and so
is what a single sensor shows of its own unit."""


def of_the_craft(
    findings: Sequence[Finding], unjudged: Iterable[Unjudged], flights: Sequence[str]
) -> tuple[Finding, ...]:
    """The findings of one check on these flights, with what blocks some of them also on those that
    leave it open, if no flight denies it. A warning of the same question is taken up in that."""
    proved: dict[str, list[Finding]] = {}
    for one in findings:
        if one.severity == "blocking" and one.check in OF_THE_FILE:
            proved.setdefault(one.where, []).append(one)
    out = list(findings)
    for where, said in proved.items():
        asked = [u for u in unjudged if u.check == said[0].check and _asks(u, where)]
        if len({_claim(f) for f in said}) > 1:
            continue  # flights contradict each other: no file does that
        ill = (MOTORS, said[0].check)
        odd = [f for f in findings if f.check in ill and f.severity != "info"]
        doubts = [f for f in odd if f.severity == "warning" and f.where == where]
        named = {f.flight for f in said}
        others = [n for n in flights if n not in named]
        if set(others) - {u.flight for u in asked} - {f.flight for f in odd}:
            continue  # a flight shows it right
        open_ = {u.flight for u in asked if u.open} | {f.flight for f in doubts}
        silent = [n for n in others if n in open_]
        out = [f for f in out if f not in doubts or f.flight in named]
        out += [replace(said[0], flight=n, message=_by_others(said)) for n in silent]
    return tuple(out)


def _claim(found: Finding) -> str:
    """What it says, without its numbers."""
    return re.sub(r"[-+]?\d[\d.]*", "#", found.message.partition("; ")[0])


def _asks(left: Unjudged, where: str) -> bool:
    """Whether what was not judged is what a finding there is about."""
    return not left.part or left.part == PARTS.get(where)


def _by_others(said: Sequence[Finding]) -> str:
    names = ", ".join(dict.fromkeys(f.flight for f in said))
    text, _, _ = said[0].message.partition("; ")
    return f"{text} (by {names}; this flight does not tell)"
