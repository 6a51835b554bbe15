"""Check of saturation: commands at their limits, sensors at the end of their range."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from greybox.data.channel import group_names
from greybox.data.checks.finding import Check, Finding, Unjudged, per_flight
from greybox.data.checks.view import FloatArray, View

SHARE = 0.01
CLIPPED_ROWS = 5
BELOW = 0.05
"""A sensor that clips shows its largest value more often than all others within this share of the
way from it to the median: motion passes."""
STEPS = 3
"""Those of at least so many steps of a coarse sensor: the top of a parabola stays in its topmost
step for as long as in the next three."""
ROTORS = 2
"""A floor is the same of so many rotors; the least command of one alone is where it happened to
be."""
MORE = "fly with more headroom (lighter craft, full battery, gentler manoeuvres)"
SENSORS = ("rate", "specific_force")


def run(view: View) -> Iterator[Finding | Unjudged]:
    """Findings on commands at u_min or u_max and on clipped sensors in flight."""
    if view.flight is None:
        yield Unjudged(
            check="saturation", flight=view.name, reason="no airborne stretch on a usable clock"
        )
        return
    actuator = view.vehicle.actuator
    tiny = 1e-3 * (actuator.u_max - actuator.u_min)
    u = view.group("command") if view.commanded and view.drives else np.zeros((0, 1))
    u = u[np.isfinite(u).all(axis=1)]
    for what, mask in (
        ("u_max", u >= actuator.u_max - tiny),
        ("u_min", u <= actuator.u_min + tiny),
    ):
        share = float(mask.any(axis=1).mean()) if u.size else 0.0
        if share > SHARE:
            worst = int(np.argmax(mask.mean(axis=0)))
            yield Finding(
                check="saturation",
                severity="warning",
                flight=view.name,
                where=f"channel u{worst + 1} and others",
                message=f"a command is at {what} for {100 * share:.1f} % of the flight",
                evidence={"share": share, f"share_u{worst + 1}": float(mask[:, worst].mean())},
                fix=MORE,
            )
    yield from _floor(view, actuator.u_min + tiny)
    log = view.increasing
    for group in SENSORS:
        for name in group_names(group):
            values = log.channels.get(name, np.full(1, np.nan))
            if not np.isfinite(values).any():
                continue
            for size in (values, -values):
                top = float(np.nanmax(size, initial=0.0))
                clipped = int((size == top).sum())
                near = _next(size, top)
                if top > 0.0 and clipped >= CLIPPED_ROWS and clipped > near:
                    yield Finding(
                        check="saturation",
                        severity="warning",
                        flight=view.name,
                        where=f"channel {name}, row {log.rows[int(np.nanargmax(size))]}",
                        message=f"{clipped} row(s) at the same extreme value {top:.5g}: the sensor "
                        "clips",
                        evidence={"rows": clipped, "limit": top},
                        fix="set a larger sensor range, or leave these cells empty",
                    )
                    break


def _floor(view: View, known: float) -> Iterator[Finding]:
    """A floor of the commands above `known`, the least of the vehicle file, as the idle of a
    firmware: one exact value that several rotors share, more often than the next steps: else
    commands grow fewer towards their least."""
    log, drives = view.increasing, view.drive_names
    if view.flight is None or not (view.commanded and view.drives) or len(drives) < ROTORS:
        return
    rows = np.zeros(log.n, dtype=bool)
    for segment in view.flight.segments:
        rows |= (log.t >= segment.t[0]) & (log.t <= segment.t[-1])
    u = np.column_stack([log.channels[name][rows] for name in drives])
    u = u[np.isfinite(u).all(axis=1)]
    if not u.size or not known < (low := float(u.min())) < np.median(u):
        return
    above, at = np.unique(u)[1 : STEPS + 1], u == low
    share, held = float(at.any(axis=1).mean()), at.any(axis=0)
    heap = at.sum() > np.isin(u, above).sum()
    if share > SHARE and held.sum() >= ROTORS and heap:
        worst = int(np.argmax(at.mean(axis=0)))
        yield Finding(
            check="saturation",
            severity="warning",
            flight=view.name,
            where=f"channel u{worst + 1} and others",
            message=f"a command is at the same least value {low:.4g} for {100 * share:.1f} % of "
            "the flight: the firmware lets none below it",
            evidence={"share": share, f"share_u{worst + 1}": float(at[:, worst].mean())},
            fix=MORE,
        )


def _next(size: FloatArray, top: float) -> int:
    """Number of values next below the largest one, `top`."""
    below = size[size < top]
    edge = top - BELOW * (top - np.nanmedian(size))
    return int((below >= np.min(np.unique(below)[-STEPS:], initial=edge)).sum())


CHECK = Check(
    name="saturation", question="Do commands or sensors reach their limits?", run=per_flight(run)
)
