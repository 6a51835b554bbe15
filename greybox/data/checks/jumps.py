"""Check of jumps: rows that were cut out while the clock went on, stretches that come twice, and
positions or attitudes that jump.

Pose and velocity are smooth. A step is what lies between the lines through the samples before an
instant and through those after it; medians of five samples come first, so that a lone outlier is
none. Steps are compared with the usual ones of the flight.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from greybox.data.checks.finding import Check, Finding, Unjudged, per_flight
from greybox.data.checks.view import FloatArray, View
from greybox.data.resampling import continuous_signs

SMOOTH = ("position", "velocity", "attitude")
SIDE = 0.05
"""Length of the lines on either side [s], at least four samples."""
USUAL = 99.0
"""Percentile of the steps that counts as usual."""
JUMP = 20.0
"""A step of one group of this many times the usual one is a jump ..."""
BOTH = 4.0
"""... and rows are missing there where another group steps by this much too."""
TWICE = 0.1
"""Stretches of at least this time [s] and ten rows that are there twice, number by number, are
said."""


def steps(values: FloatArray, side: int) -> FloatArray:
    """Size of the step behind each sample (N,) of (N, k); 0 at the ends and next to missing
    ones."""
    n = values.shape[0]
    out = np.zeros(n)
    if n < 2 * side + 4:
        return out
    windows = np.lib.stride_tricks.sliding_window_view(values, 5, axis=0)
    middle = values.copy()
    middle[2:-2] = np.median(windows, axis=2)
    line = np.linalg.pinv(np.column_stack([np.ones(side), np.arange(side)]))
    parts = np.lib.stride_tricks.sliding_window_view(middle, side, axis=0)
    before = parts[: n - 2 * side + 1] @ (line[0] + line[1] * (side - 0.5))
    after = parts[side:] @ (line[0] - 0.5 * line[1])
    out[side - 1 : n - side] = np.nan_to_num(np.linalg.norm(after - before, axis=1))
    return out


def run(view: View) -> Iterator[Finding | Unjudged]:
    """Findings on jumps and on stretches that come twice."""
    if view.flight is None:
        yield Unjudged(
            check="jumps", flight=view.name, reason="no airborne stretch on a usable clock"
        )
        return
    repeated = list(_repeated(view))
    if repeated:
        yield from repeated
        return
    groups = [g for g in SMOOTH if view.has(g)]
    if not groups:
        yield Unjudged(check="jumps", flight=view.name, reason="no position, velocity or attitude")
        return
    side = max(4, round(SIDE / view.dt))
    sizes = {}
    for group in groups:
        values = view.group(group)
        size = steps(continuous_signs(values)[0] if group == "attitude" else values, side)
        known = size[size > 0]
        if known.size > 10 * side and (usual := float(np.percentile(known, USUAL))) > 0:
            sizes[group] = size / usual
    yield from _jumps(view, sizes, side)


def _jumps(view: View, sizes: dict[str, FloatArray], side: int) -> Iterator[Finding]:
    """One finding for all jumps: the largest is named, the others are counted."""
    if not sizes:
        return
    most = np.max(list(sizes.values()), axis=0)
    places = []
    said = np.zeros(most.size, dtype=bool)
    large = np.flatnonzero(most > JUMP)
    for k in large[np.argsort(-most[large], kind="stable")].tolist():
        if not said[k]:
            near = slice(max(k - 2 * side, 0), k + 2 * side + 1)
            places.append((k, {g: float(s[near].max()) for g, s in sizes.items()}))
            said[near] = True
    if not places:
        return
    several = [(k, s) for k, s in places if sum(v > BOTH for v in s.values()) > 1]
    k, size = (several or places)[0]
    t = float(view.time[k])
    jumping = [g for g, v in size.items() if v > BOTH]
    if several:
        message = (
            f"{' and '.join(jumping)} jump together at t = {t:.2f} s: rows are missing "
            "there, but the clock goes on"
        )
    else:
        message = f"the {jumping[0]} jumps at t = {t:.2f} s"
    if len(places) > 1:
        message += f" ({len(places)} such places)"
    yield Finding(
        check="jumps",
        severity="blocking" if several else "warning",
        flight=view.name,
        where=f"t = {t:.3f} s",
        message=message,
        evidence={"time_s": t, "places": len(places)}
        | {f"{g}_over_usual": v for g, v in size.items()},
        fix="cut the log there into two, or give the rows after it their true times",
    )


def _repeated(view: View) -> Iterator[Finding]:
    """A stretch of the log whose measurements are those of an earlier one, number by number."""
    log = view.increasing
    names = [n for n in log.channels if n != "vbat"]
    rows = np.nan_to_num(np.column_stack([log.channels[n] for n in names]))
    keys: npt.NDArray[np.void] = np.ascontiguousarray(rows).view(
        f"V{rows.dtype.itemsize * rows.shape[1]}"
    )[:, 0]
    _, first, which = np.unique(keys, return_index=True, return_inverse=True)
    back = np.arange(log.n) - first[which]  # how many rows ago it was there for the first time
    least = max(10, round(TWICE * view.rate))
    edges = np.flatnonzero(np.diff(back, prepend=-1, append=-1) != 0)
    long = (np.diff(edges) >= least) & (back[edges[:-1]] > 0)
    for a, b in zip(edges[:-1][long], edges[1:][long], strict=True):
        if np.unique(which[a:b]).size < least:
            continue
        yield Finding(
            check="jumps",
            severity="blocking",
            flight=view.name,
            where=f"row {log.rows[a]}",
            message=f"{b - a} rows from t = {log.t[a]:.2f} s are those from t = "
            f"{log.t[a - back[a]]:.2f} s again",
            evidence={
                "rows": int(b - a),
                "time_s": float(log.t[a]),
                "before_s": float(log.t[a - back[a]]),
            },
            fix="drop the stretch that is there twice, or keep one part of the log",
        )
        return


CHECK = Check(
    name="jumps", question="Does the motion go on where the clock does?", run=per_flight(run)
)
