"""Check of gaps: stretches without rows, and cells without values."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from greybox.data.checks.finding import Check, Finding, Unjudged, per_flight
from greybox.data.checks.view import View
from greybox.data.conditioning import MAX_GAP

LOST = 0.2
"""Share of the flight without rows from which a fit is blocked."""

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
            severity="warning" if missing > 0.02 * log.n else "info",
            flight=view.name,
            where=f"first at t = {log.t[short[0]]:.3f} s",
            message=f"{missing} dropped sample(s); they are kept as missing",
            evidence={"dropped": missing, "share": missing / log.n},
            fix="log with more bandwidth",
        )
    for name in view.raw.empty:
        yield Finding(
            check="gaps",
            severity="warning",
            flight=view.name,
            where=f"channel {name}",
            message="the column holds no value at all; it is left out",
            fix="log it, or drop the column",
        )
    for name, values in log.channels.items():
        share = float(np.isnan(values).mean())
        if share > 0.5 and name not in SLOW:
            yield Finding(
                check="gaps",
                severity="warning",
                flight=view.name,
                where=f"channel {name}",
                message=f"{100 * share:.0f} % of the cells are empty",
                evidence={"missing_share": share},
                fix="log that channel faster or in a steady rhythm, or fit with --predictor kalman",
            )


CHECK = Check(name="gaps", question="Are rows or cells missing?", run=per_flight(run))
