"""Which rows of a log are flight: cuts take-off, landing and standing on the ground, and says what it cut.

Only stretches at the ends of the log, or with the motors near idle, are taken for the ground; a log that begins and
ends in flight is left whole.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from greybox.data.channel import command_names
from greybox.runs import runs

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

CLEAR_HEIGHT = 0.25
"""Height above the ground [m] from which a row counts as flight (half the flown height, where that is less)."""

FLAT = 0.02
"""On the ground the height stays within this range [m] ..."""

WINDOW = 0.3
"""... over this time [s] at the end of the log."""

MARGIN = 0.5
"""Without a height, this much time [s] next to the ground is cut as take-off and landing."""

IDLE_TIME = 1.0
"""Inside a log, motors below half the hover command for this long [s] mean that the craft stands."""


def _held(values: FloatArray) -> FloatArray:
    """Missing values replaced by the last one before (0 before the first): used to judge, never handed on."""
    known = np.isfinite(values)
    last = np.maximum.accumulate(np.where(known, np.arange(values.size), -1))
    return np.where(last >= 0, values[np.maximum(last, 0)], 0.0)


def airborne(
    t: FloatArray, channels: Mapping[str, FloatArray], *, u_min: float = 0.0
) -> tuple[BoolArray, tuple[str, ...]]:
    """(rows of flight (N,), notes) of a log with increasing stamps `t` (N,) [s].

    The hover level is the median of the mean command while the motors run. A log without commands, or whose motors
    never ran, is left whole, and the notes say so.
    """
    everything = np.ones(t.size, dtype=bool)
    commands = command_names(channels)
    if not commands:
        return everything, ("no commands: take-off and landing not looked for",)
    mean = np.mean([_held(channels[n]) for n in commands], axis=0) - u_min
    top = float(np.percentile(mean, 95))
    if top <= 0.0:
        return everything, ("the motors never ran: take-off and landing not looked for",)
    level = float(np.median(mean[mean > 0.3 * top]))
    height = channels.get("z")
    ground = _standing(t, mean / level, height)
    keep = everything.copy()
    for start, stop in ground:
        first, last = _widened(t, mean / level, height, start, stop)
        keep[first:last] = False
    if keep.sum() < max(2, 0.02 * t.size):
        return everything, ("no flight found by command and height: nothing cut",)
    notes = tuple(
        f"on the ground or near it: cut t = {t[a]:.3f} .. {t[b - 1]:.3f} s ({b - a} rows)" for a, b in runs(~keep)
    )
    return keep, notes or ("begins and ends in flight: nothing cut",)


def _flat(height: FloatArray | None, rows: slice) -> bool | None:
    """Whether the height stays put over these rows; None where there is no height."""
    if height is None:
        return None
    seen = height[rows][np.isfinite(height[rows])]
    return bool(np.ptp(seen) < FLAT) if seen.size >= 3 else None


def _standing(t: FloatArray, share: FloatArray, height: FloatArray | None) -> Sequence[tuple[int, int]]:
    """Row ranges on the ground: at the ends of the log, and inside it with idle motors."""
    n = t.size
    idle = [(a, b) for a, b in runs(share < 0.5) if t[b - 1] - t[a] >= IDLE_TIME]
    strong = np.flatnonzero(share >= 0.7)
    head = slice(0, int(np.searchsorted(t, t[0] + WINDOW)))
    tail = slice(int(np.searchsorted(t, t[-1] - WINDOW)), n)
    ends = []
    grounds = []
    for rows, low in (
        (head, t[strong[0]] - t[0] > 0.05 if strong.size else True),
        (tail, t[-1] - t[strong[-1]] > 0.05 if strong.size else True),
    ):
        flat = _flat(height, rows)
        at_rest = low if flat is None else flat and (low or float(np.median(share[rows])) < 0.85)
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


def _widened(t: FloatArray, share: FloatArray, height: FloatArray | None, start: int, stop: int) -> tuple[int, int]:
    """The rows around a standing stretch that are not flight: up to the clear height, or the time margin."""
    strong = share >= 0.7
    if height is not None:
        seen = height[start:stop][np.isfinite(height[start:stop])]
        flown = height[strong & np.isfinite(height)]
        if seen.size and flown.size:
            ground = float(np.median(seen))
            clear = min(CLEAR_HEIGHT, 0.5 * (float(np.median(flown)) - ground))
            if clear > FLAT:
                high = np.flatnonzero(height > ground + clear)
                before, after = high[high < start], high[high >= stop]
                return (int(before[-1]) + 1 if before.size else 0), (int(after[0]) if after.size else t.size)
    flying = np.flatnonzero(strong)
    before, after = flying[flying < start], flying[flying >= stop]
    first = int(np.searchsorted(t, t[before[-1]] - MARGIN)) if before.size else 0
    last = int(np.searchsorted(t, t[after[0]] + MARGIN)) if after.size else t.size
    return first, last
