"""Check of frozen samples: a sensor, or the commands, that repeat their last value while the craft
flies.

A group is frozen when all of it is: one component of a pose may stand still, and one command stays
at its limit. Each axis of an IMU has noise of its own and never does, unless its numbers are coarse.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from greybox.data.channel import group_names
from greybox.data.checks.finding import Check, Finding, Unjudged, per_flight
from greybox.data.checks.view import FloatArray, View
from greybox.data.repeats import LATE, held_over
from greybox.runs import runs

NOISY = ("rate", "specific_force")
"""Groups of which every axis is looked at."""
GROUPS = ("command", *NOISY, "attitude", "position", "velocity")
FROZEN_TIME = 0.2
"""A group that keeps its values for this long [s] in flight is frozen ..."""

FROZEN_ROWS = 10
"""... and for this many rows ..."""

COARSE = 3.0
"""... in which it usually changes by more than this many of its smallest steps: coarse numbers of a
calm flight repeat."""

BLOCKING_SHARE = 0.05


def frozen_runs(values: FloatArray, rows: int) -> list[tuple[int, int]]:
    """(start, stop) of the runs of at least `rows` rows of (N, k) in which no column changes."""
    same = (np.diff(values, axis=0) == 0.0).all(axis=1)
    return [(a, b + 1) for a, b in runs(same) if b + 1 - a >= rows]


def _range(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Smallest and largest of the known values (N, k) of every column."""
    known = np.isfinite(values)
    return np.where(known, values, np.inf).min(axis=0), np.where(known, values, -np.inf).max(axis=0)


def _moves(values: FloatArray, rows: int) -> bool:
    """Whether (N, k) usually changes over so many rows by more than `COARSE` of its smallest
    steps."""
    step = np.abs(np.diff(values, axis=0))
    step = step[step > 0]
    change = np.abs(values[rows:] - values[:-rows]).max(axis=1)
    change = change[np.isfinite(change)]
    return bool(step.size and change.size and np.percentile(change, 75) > COARSE * step.min())


def _left_at_once(values: FloatArray, found: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Those runs of one axis (N, 1) that end by more than `COARSE` of its smallest steps, or with
    the flight: coarse numbers of a slow motion come and go step by step."""
    step = np.abs(np.diff(values[:, 0]))
    least = step[step > 0].min(initial=np.inf)
    return [(a, b) for a, b in found if b == len(values) or step[b - 1] > COARSE * least]


def _far_longer(values: FloatArray, found: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """The longest run of commands (N, k), where it is `LATE` times as long as any other: others
    are how the craft is commanded."""
    lengths = [1, 1, *sorted(b - a for a, b in frozen_runs(values, 2))]
    return [(a, b) for a, b in found if b - a == lengths[-1] > LATE * lengths[-2]]


def run(view: View) -> Iterator[Finding | Unjudged]:
    """Findings on measured groups that stand still in flight, and on channels that never move."""
    if view.flight is None or view.clock is None:
        yield Unjudged(
            check="frozen", flight=view.name, reason="no airborne stretch on a usable clock"
        )
        return
    log = view.as_logged  # what a slow stream repeats, too
    first, last = view.flight.segments[0].t[0], view.flight.segments[-1].t[-1]
    rows = slice(*np.searchsorted(log.t, [first, last]).tolist())
    t = log.t[rows]
    for group in GROUPS:
        every = group_names(group, len(view.vehicle.rotors))
        names = [n for n in every if n in log.channels]
        if not names or t.size <= _rows(view):
            continue
        values = np.column_stack([log.channels[n][rows] for n in names])
        low, high = _range(values)
        dead = low == high
        if group in NOISY and dead.any() and not dead.all():
            yield _dead(view, [n for n, same in zip(names, dead, strict=True) if same])
        if (whole := _stands(view, group, names, t, values)) is not None:
            yield whole
        elif group in NOISY:
            for i in np.flatnonzero(~dead):
                if (one := _stands(view, group, [names[i]], t, values[:, [i]])) is not None:
                    yield one


def _rows(view: View) -> int:
    """Rows that a group must keep its values for."""
    assert view.clock is not None
    return max(FROZEN_ROWS, int(np.ceil(FROZEN_TIME / view.clock.dt)))


def _stands(
    view: View, group: str, names: list[str], t: FloatArray, values: FloatArray
) -> Finding | None:
    """What of a group keeps its values (N, k) at the times t (N,) for as many rows as `_rows`
    asks, or longer where a slow stream repeats; None where nothing does."""
    commands = group == "command"
    known = np.isfinite(values)
    low, high = _range(values)
    dead = bool((low == high).all()) and not commands
    longer = max(_rows(view), LATE * held_over(values[known.all(axis=1)]))
    runs = [(a, b) for a, b in frozen_runs(values, longer) if view.in_flight(t[a])]
    if len(names) == 1:
        runs = _left_at_once(values, runs)
    # At the end of its range a sensor is clipped and a motor at its limit.
    runs = [(a, b) for a, b in runs if ((values[a] > low) & (values[a] < high)).any() or dead]
    if commands:
        runs = _far_longer(values, runs)
    if not runs or not (dead or _moves(values, longer)):
        return None
    longest = max(runs, key=lambda ab: ab[1] - ab[0])
    total = sum(b - a for a, b in runs)
    share = total / max(t.size, 1)
    seconds = float(t[longest[1] - 1] - t[longest[0]])
    kept = ", ".join(f"{v:.6g}" for v in values[longest[0]])
    return Finding(
        check="frozen",
        severity="blocking"
        if share > BLOCKING_SHARE and len(names) > 1 and not commands
        else "warning",
        flight=view.name,
        where=f"{', '.join(names)}, from t = {t[longest[0]]:.3f} s",
        message=f"{', '.join(names)} keep{'s' if len(names) == 1 else ''} the value {kept} for "
        f"{seconds:.3f} s",
        evidence={
            "frozen_rows": total,
            "frozen_share": share,
            "longest_s": seconds,
            "start_s": float(t[longest[0]]),
        },
        fix="leave the cells empty where nothing new was measured or sent",
    )


def _dead(view: View, names: list[str]) -> Finding:
    return Finding(
        check="frozen",
        severity="warning",
        flight=view.name,
        where=", ".join(names),
        message=f"{', '.join(names)} never changes in flight, the rest of the sensor does",
        fix="leave the column out where the sensor does not measure it (a simulated craft "
        "without drag feels no side force: keep it)",
    )


CHECK = Check(name="frozen", question="Does a sensor repeat its last value?", run=per_flight(run))
