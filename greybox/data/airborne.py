"""Which rows of a log are flight: cuts take-off, landing and standing on the ground, and says what
it cut.

Only stretches at the ends of the log, or with the motors near idle, are taken for the ground; a log
that begins and ends in flight is left whole.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from greybox.data.repeats import LATE
from greybox.data.stillness import Motion, motion_of, stiller_than_in_flight
from greybox.runs import runs

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

CLEAR_HEIGHT = 0.25
"""Height above the ground [m] from which a row counts as flight (half the flown height, where that
is less)."""

FLAT = 0.02
"""On the ground the height stays within this range [m] ..."""

WINDOW = 0.3
"""... over this time [s] at the end of the log."""

MARGIN = 0.5
"""Without a height, this much time [s] next to the ground is cut as take-off and landing."""

WEAK = 0.85
"""Below this share of the hover command a craft falls by several times `FLAT` in `WINDOW`. Nearer to
it that is not sure: the hover level is not known so well."""

IDLE_TIME = 1.0
"""Inside a log, motors below half the hover command for this long [s] mean that the craft
stands."""


def _held(values: FloatArray) -> FloatArray:
    """Missing values replaced by the last one before (0 before the first): used to judge, never
    handed on."""
    known = np.isfinite(values)
    last = np.maximum.accumulate(np.where(known, np.arange(values.size), -1))
    return np.where(last >= 0, values[np.maximum(last, 0)], 0.0)


def _handed_on(values: FloatArray) -> FloatArray:
    """Samples of a slow stream in the rows until the next; what is missing longer stays so."""
    known = np.flatnonzero(np.isfinite(values))
    if known.size < 2:
        return values
    last = np.searchsorted(known, np.arange(values.size), side="right") - 1
    age = np.arange(values.size) - known[np.maximum(last, 0)]
    there = (last >= 0) & (age <= LATE * int(np.median(np.diff(known))))
    return np.where(there, values[known[np.maximum(last, 0)]], np.nan)


def airborne(
    t: FloatArray,
    channels: Mapping[str, FloatArray],
    *,
    driving: Sequence[str],
    u_min: float = 0.0,
) -> tuple[BoolArray, tuple[str, ...]]:
    """(rows of flight (N,), notes) of a log with increasing stamps `t` (N,) [s].

    The hover level is the median of the mean of the channels `driving` the rotors (commands, which
    begin at `u_min`, or rotor speeds) while the motors run. A log without them, or whose motors
    never ran, is left whole, and the notes say so.
    """
    everything = np.ones(t.size, dtype=bool)
    if not driving:
        return everything, ("no commands: take-off and landing not looked for",)
    mean = np.mean([_held(channels[n]) for n in driving], axis=0) - u_min
    top = float(np.percentile(mean, 95))
    if top <= 0.0:
        return everything, ("the motors never ran: take-off and landing not looked for",)
    level = float(np.median(mean[mean > 0.3 * top]))
    height = _handed_on(channels["z"]) if "z" in channels else None
    share = mean / level
    turns = motion_of(t, np.column_stack([_held(channels[n]) for n in driving]), channels)
    standing = _standing(t, share, height, turns)
    ground = _with_take_off_and_landing(t, share, height, standing)
    covers = np.zeros(t.size + 1, dtype=np.int64)
    for first, last in ground:
        covers[first] += 1
        covers[last] -= 1
    keep = np.cumsum(covers[:-1]) == 0
    if keep.sum() < max(2, 0.02 * t.size):
        return everything, ("no flight found by command and height: nothing cut",)
    notes = tuple(
        f"on the ground or near it: cut t = {t[a]:.3f} .. {t[b - 1]:.3f} s ({b - a} rows)"
        for a, b in runs(~keep)
    )
    return keep, notes or ("begins and ends in flight: nothing cut",)


def _flat(height: FloatArray | None, rows: slice) -> bool | None:
    """Whether the height stays put over these rows; None where there is no height."""
    if height is None:
        return None
    seen = height[rows][np.isfinite(height[rows])]
    return bool(np.ptp(seen) < FLAT) if seen.size >= 3 else None


def _stays(t: FloatArray, height: FloatArray | None) -> float:
    """Time [s] from the first row on over which the height stays put, less that of a take-off; 0
    where it never leaves, or not upwards."""
    if height is None:
        return 0.0
    near = height[t < t[0] + WINDOW]
    base = float(np.median(near[np.isfinite(near)])) if np.isfinite(near).any() else np.nan
    left = np.flatnonzero(np.abs(height - base) > FLAT)
    higher = float(np.nanmedian(height)) - base > FLAT
    return max(float(t[left[0]] - t[0]) - MARGIN, 0.0) if left.size and higher else 0.0


def _unmoved(t: FloatArray, height: FloatArray | None, turns: Motion | None, end: int) -> bool:
    """Whether the craft keeps stiller at the beginning (`end` 0), or at the end (1), than its
    commands let it in flight, while its height stays put."""
    if height is None or turns is None:
        return False
    head, tail = _stays(t, height), _stays(-t[::-1], height[::-1])
    first, last = float(t[0]), float(t[-1])
    flight = (
        first + (head + 2.0 * MARGIN) * (head > 0.0),
        last - (tail + 2.0 * MARGIN) * (tail > 0.0),
    )
    start, stop = ((first, first + head), (last - tail, last))[end]
    return stop - start > WINDOW and stiller_than_in_flight(turns, (start, stop), flight)


def _standing(
    t: FloatArray, share: FloatArray, height: FloatArray | None, turns: Motion | None
) -> Sequence[tuple[int, int]]:
    """Row ranges on the ground: at the ends of the log, and inside it with idle motors."""
    n = t.size
    idle = [(a, b) for a, b in runs(share < 0.5) if t[b - 1] - t[a] >= IDLE_TIME]
    strong = np.flatnonzero(share >= 0.7)
    head = slice(0, int(np.searchsorted(t, t[0] + WINDOW)))
    tail = slice(int(np.searchsorted(t, t[-1] - WINDOW)), n)
    ends = []
    grounds = []
    for end, rows, low in (
        (0, head, t[strong[0]] - t[0] > 0.05 if strong.size else True),
        (1, tail, t[-1] - t[strong[-1]] > 0.05 if strong.size else True),
    ):
        flat = _flat(height, rows)
        falls = float(np.median(share[rows])) < WEAK
        # How still it keeps takes longest to find, and is asked last.
        at_rest = (
            low if flat is None else flat and (low or falls or _unmoved(t, height, turns, end))
        )
        ends.append((rows, flat, at_rest))
        if at_rest and height is not None and flat:
            grounds.append(float(np.nanmedian(height[rows])))
    for rows, flat, at_rest in ends:
        same = bool(flat and height is not None) and any(
            abs(float(np.nanmedian(height[rows])) - g) < 0.03  # type: ignore[index]
            for g in grounds
        )
        if at_rest or same:
            weak = t[rows][share[rows] < 0.7] if flat is None else t[rows]
            if weak.size:
                first = int(np.searchsorted(t, weak[0]))
                idle.append((first, int(np.searchsorted(t, weak[-1])) + 1))
    return sorted(idle)


def _with_take_off_and_landing(
    t: FloatArray,
    share: FloatArray,
    height: FloatArray | None,
    stretches: Sequence[tuple[int, int]],
) -> list[tuple[int, int]]:
    """The rows around standing stretches that are not flight: up to the clear height, or the time
    margin."""
    strong = share >= 0.7
    flying = np.flatnonzero(strong)
    flown = height[strong & np.isfinite(height)] if height is not None else np.zeros(0)
    usual = float(np.median(flown)) if flown.size else np.nan
    known = np.where(np.isnan(height), -np.inf, height) if height is not None else np.zeros(0)
    ahead, behind = _tree(known), _tree(known[::-1])
    out = []
    for start, stop in stretches:
        seen = known[start:stop][np.isfinite(known[start:stop])]
        ground = float(np.median(seen)) if seen.size else np.nan
        clear = float(
            np.minimum(CLEAR_HEIGHT, 0.5 * (usual - ground))
        )  # NaN where either is not known
        if clear > FLAT:
            first = t.size - _first_above(behind, t.size - start, ground + clear)
            last = _first_above(ahead, stop, ground + clear)
        else:
            after = int(np.searchsorted(flying, stop))
            before = int(np.searchsorted(flying, start)) - 1
            first = int(np.searchsorted(t, t[flying[before]] - MARGIN)) if before >= 0 else 0
            last = (
                int(np.searchsorted(t, t[flying[after]] + MARGIN))
                if after < flying.size
                else t.size
            )
        out.append((first, last))
    return out


def _tree(values: FloatArray) -> list[FloatArray]:
    """The values (N,) and, level by level, the larger of every two neighbours: a log has as many
    stretches as it is long, and each looks for its end."""
    levels = [values]
    while levels[-1].size > 1:
        last = levels[-1]
        levels.append(np.maximum(last[::2], np.append(last[1::2], [-np.inf] * (last.size % 2))))
    return levels


def _first_above(levels: Sequence[FloatArray], start: int, limit: float) -> int:
    """First place from `start` on at which a value of the tree is above the limit; their number
    where none is."""
    level, at = 0, start
    while at < levels[level].size:
        if levels[level][at] > limit:
            while level:
                level, at = level - 1, 2 * at
                at += not levels[level][at] > limit
            return at
        at += 1
        while at % 2 == 0 and level + 1 < len(levels):
            level, at = level + 1, at // 2
    return int(levels[0].size)
