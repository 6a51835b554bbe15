"""Check of the position against the velocity: millimetres, or a clock of another rate, show in their ratio.

Displacements over half a second are compared with the integral of the velocity over the same time.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from greybox.data.checks.finding import Check, Finding, Unjudged
from greybox.data.checks.view import View

SPAN = 0.5
"""Time [s] over which displacements are taken."""

MOVING = 0.02
"""Displacements of less than this [m RMS] show nothing."""

SEEN = 0.8
"""Correlation of the two from which their ratio means something."""

WARNING, BLOCKING = 1.25, 1.6
"""Factors between the two, either way."""


def run(view: View) -> Iterator[Finding | Unjudged]:
    """A finding where position and velocity differ by a factor."""
    if not view.has("position", "velocity"):
        yield Unjudged(check="motion", flight=view.name, reason="no position with velocity")
        return
    position, velocity = view.group("position"), view.group("velocity")
    n = max(1, round(SPAN / view.dt))
    steps = 0.5 * (velocity[1:] + velocity[:-1]) * view.dt
    there = np.isfinite(steps)
    integral, lost = np.cumsum(np.where(there, steps, 0.0), axis=0), np.cumsum(~there, axis=0)
    moved, told = position[n + 1 :] - position[1:-n], integral[n:] - integral[:-n]
    use = np.isfinite(moved) & (lost[n:] == lost[:-n])
    a, b = moved[use], told[use]
    size = float(np.sqrt(np.mean(b**2))) if b.size else 0.0
    if size < MOVING:
        yield Unjudged(check="motion", flight=view.name, reason=f"the craft hardly moves ({size:.2g} m in {SPAN:g} s)")
        return
    ratio = float(np.sqrt(np.mean(a**2))) / size
    correlation = float(np.mean(a * b)) / (ratio * size**2) if ratio > 0 else 0.0
    off = max(ratio, 1 / ratio) if ratio > 0 else np.inf
    if correlation < SEEN or off < WARNING:
        return
    yield Finding(
        check="motion",
        severity="blocking" if off > BLOCKING else "warning",
        flight=view.name,
        where="x, y, z against vx, vy, vz",
        message=f"the position moves {ratio:.3g} times as far as the velocity says",
        evidence={"position_over_velocity": ratio, "correlation": correlation},
        fix="check the unit of both in [columns], and that the time is in seconds and of this log",
    )


CHECK = Check(name="motion", question="Do position and velocity tell the same story?", run=run)
