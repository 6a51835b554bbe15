"""Check of frozen samples: a sensor that repeats its last value while the craft flies."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from greybox.data.channel import group_names
from greybox.data.checks.finding import Check, Finding, Unjudged, per_flight
from greybox.data.checks.view import FloatArray, View

GROUPS = ("rate", "specific_force", "attitude", "position", "velocity")
FROZEN_TIME = 0.2
"""A channel that keeps its value for this long [s] in flight is frozen ..."""

FROZEN_ROWS = 10
"""... and for this many rows."""

BLOCKING_SHARE = 0.05


def frozen_runs(values: FloatArray, rows: int) -> list[tuple[int, int]]:
    """(start, stop) of the runs of at least `rows` equal values of (N,)."""
    same = np.concatenate([[False], np.diff(values) == 0.0, [False]]).astype(np.int8)
    edges = np.flatnonzero(np.diff(same))
    return [(int(a), int(b) + 1) for a, b in zip(edges[::2], edges[1::2], strict=True) if b + 1 - a >= rows]


def run(view: View) -> Iterator[Finding | Unjudged]:
    """Findings on measured channels that stand still in flight."""
    if view.flight is None or view.clock is None:
        yield Unjudged(check="frozen", flight=view.name, reason="no airborne stretch on a usable clock")
        return
    log = view.increasing
    first, last = view.flight.segments[0].t[0], view.flight.segments[-1].t[-1]
    rows = slice(*np.searchsorted(log.t, [first, last]).tolist())
    t = log.t[rows]
    need = max(FROZEN_ROWS, int(np.ceil(FROZEN_TIME / view.clock.dt)))
    for group in GROUPS:
        for name in group_names(group):
            if name not in log.channels:
                continue
            values = log.channels[name][rows]
            runs = [(a, b) for a, b in frozen_runs(values, need) if _airborne(view, t[a])]
            if not runs:
                continue
            longest = max(runs, key=lambda ab: ab[1] - ab[0])
            total = sum(b - a for a, b in runs)
            share = total / max(values.size, 1)
            yield Finding(
                check="frozen",
                severity="blocking" if share > BLOCKING_SHARE else "warning",
                flight=view.name,
                where=f"channel {name}, from t = {t[longest[0]]:.3f} s",
                message=f"keeps the value {values[longest[0]]:.6g} for {t[longest[1] - 1] - t[longest[0]]:.3f} s",
                evidence={
                    "frozen_rows": total,
                    "frozen_share": share,
                    "longest_s": float(t[longest[1] - 1] - t[longest[0]]),
                    "start_s": float(t[longest[0]]),
                },
                fix="leave the cells empty where the sensor gave nothing new",
            )


def _airborne(view: View, t: float) -> bool:
    return view.flight is not None and any(s.t[0] <= t <= s.t[-1] for s in view.flight.segments)


CHECK = Check(name="frozen", question="Does a sensor repeat its last value?", run=per_flight(run))
