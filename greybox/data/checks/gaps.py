"""Check of gaps: stretches without rows, and cells without values."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from greybox.data.channel import GROUPS, group_names
from greybox.data.checks.finding import Check, Finding, Unjudged, per_flight
from greybox.data.checks.view import FloatArray, View
from greybox.data.conditioning import MAX_GAP
from greybox.errors import did_you_mean

LOST = 0.2
"""Share of the flight without rows from which a fit is blocked."""

TRACE = 0.02
"""Share of missing rows or cells that is worth saying."""

FEW = 20
"""Values that tell no pace."""

SLOW = ("vbat",)
"""Channels that may be logged slowly."""


def run(view: View) -> Iterator[Finding | Unjudged]:
    """Findings on missing rows and missing cells."""
    if not view.usable_clock or view.clock is None:
        yield Unjudged(check="gaps", flight=view.name, reason="the clock is not usable")
        return
    log, dt = view.increasing, view.clock.dt
    steps = np.diff(log.t)
    gaps = np.flatnonzero(steps > max(MAX_GAP, 1.5 * dt))
    lost = float((steps[gaps] - dt).sum())
    if gaps.size:
        longest = int(gaps[np.argmax(steps[gaps])])
        share = lost / float(log.t[-1] - log.t[0])
        yield Finding(
            check="gaps",
            severity="blocking" if share > LOST else "warning",
            flight=view.name,
            where=f"t = {log.t[longest]:.3f} s, row {log.rows[longest]}",
            message=f"{gaps.size} gap(s); the longest is {steps[longest]:.3f} s; segments end "
            "there",
            evidence={
                "gaps": int(gaps.size),
                "longest_s": float(steps[longest]),
                "lost_share": share,
            },
            fix="log with more bandwidth, or use the part without gaps",
        )
    short = np.flatnonzero((steps > 1.5 * dt) & (steps <= max(MAX_GAP, 1.5 * dt)))
    if short.size:
        missing = int(np.rint(steps[short] / dt - 1).sum())
        yield Finding(
            check="gaps",
            severity="warning" if missing > TRACE * log.n else "info",
            flight=view.name,
            where=f"first at t = {log.t[short[0]]:.3f} s",
            message=f"{missing} dropped sample(s); they are kept as missing",
            evidence={"dropped": missing, "share": missing / log.n},
            fix="log with more bandwidth",
        )
    yield from _lost(view)
    yield from _empty(view)


def _empty(view: View) -> Iterator[Finding]:
    """Findings on channels that miss cells."""
    log = view.increasing
    empty = {k: _missing(v) for k, v in log.channels.items() if k not in SLOW}
    some = {k: s for k, s in empty.items() if TRACE < s <= 0.5}
    if some:
        yield Finding(
            check="gaps",
            severity="info",
            flight=view.name,
            where=f"channel {', '.join(some)}",
            message="cells are empty: "
            + "; ".join(f"{percent} % of {names}" for percent, names in _alike(some).items()),
            evidence={f"missing_share_{k}": s for k, s in some.items()},
            fix="log these channels at every row",
        )
    for name, share in empty.items():
        if share > 0.5:
            yield Finding(
                check="gaps",
                severity="warning",
                flight=view.name,
                where=f"channel {name}",
                message=f"{100 * share:.0f} % of the cells are empty",
                evidence={"missing_share": share},
                fix="log that channel faster or in a steady rhythm, or fit with --predictor kalman",
            )


def _missing(values: FloatArray) -> float:
    """Share of the cells that a channel misses of those that its own pace would fill: motion
    capture on every second row misses none. Of few values every empty cell counts."""
    known = np.flatnonzero(np.isfinite(values))
    if known.size < FEW:
        return 1.0 - known.size / values.size
    steps = np.diff(known)
    pace = float(steps[steps <= 1.5 * np.median(steps)].mean())
    return max(0.0, 1.0 - known.size * pace / values.size)


def _lost(view: View) -> Iterator[Finding]:
    """A finding per group of channels that lacks a column, or the values of one; or all columns,
    where the log has others whose names are nearly theirs."""
    raw, rotors = view.raw, len(view.vehicle.rotors)
    for group in GROUPS:
        names = group_names(group, rotors)
        there = [n for n in names if n in raw.channels]
        lost = [n for n in names if n not in raw.channels]
        source = view.vehicle.columns.sources.get(group)
        own = [f.lstrip("-") for f in source.fields] if source is not None else list(names)
        each = len(own) == len(names)
        wanted = [own[names.index(n)] for n in lost] if each else own
        meant = did_you_mean(wanted, raw.extra) if lost and source is not None else ""
        if not lost or not (there or set(lost) & set(raw.empty) or meant):
            continue
        columns = ", ".join(wanted) if each else " or ".join(own)
        yield Finding(
            check="gaps",
            severity="warning",
            flight=view.name,
            where=f"channel {', '.join(lost)}",
            message=f"column {columns} is missing or holds no value: the {group.replace('_', ' ')} "
            f"({', '.join(names)}) is left out, of all that is fitted with this log, too{meant}",
            fix=f"correct the names in [columns.{group}]"
            if meant
            else "log it, or drop what is left of the group",
        )


def _alike(shares: Mapping[str, float]) -> dict[str, str]:
    """Whole per cent -> the channels that miss so much."""
    out: dict[str, str] = {}
    for name, share in shares.items():
        percent = f"{100 * share:.0f}"
        out[percent] = f"{out[percent]}, {name}" if percent in out else name
    return out


CHECK = Check(name="gaps", question="Are rows or cells missing?", run=per_flight(run))
