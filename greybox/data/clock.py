"""The clock of a log: where it stops or goes back, whether it is uniform, and its sample time."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

UNIFORM_SHIFT = 0.3
"""A clock is uniform where every stamp lies within this share of the sample time of one grid per
stretch."""


RATES = (5.0, 20000.0)
"""Sample rates [Hz] outside this range mean that the time is not in seconds."""
UNIT = "say the unit that the column of the time has: [columns.time] unit = 's' (or ms, us, ns)"
"""What to do about it."""
GOES_BACK = (
    "where another flight begins there, give it a log (data set) of its own; sort rows that are "
    "merely out of order"
)
"""What to do where time goes back."""
STANDS_STILL = "drop repeated rows; stamps that were rounded (whole seconds, float32) must be finer"
"""What to do where time stands still."""


def no_flight_log(rate: float) -> str | None:
    """What is wrong with a sample rate [Hz] that no flight log has; None where nothing is."""
    if RATES[0] <= rate <= RATES[1]:
        return None
    return f"a sample rate of {rate:.4g} Hz, as no flight log has: the time is hardly in seconds"


@dataclass(frozen=True, kw_only=True, eq=False)
class Clock:
    """What a log's time stamps look like. `dt` [s] sample time, `uniform` whether the stamps lie on
    one grid.

    `blocks` are (start, stop) rows between gaps; `slots` (N,) the place of each row on the grid of
    its block (uniform clocks only); `shift` [s] the largest distance of a stamp from its slot;
    `jitter` the 1 % to 99 % range of the steps as a share of `dt`.
    """

    dt: float
    uniform: bool
    blocks: tuple[tuple[int, int], ...]
    slots: npt.NDArray[np.int64]
    shift: float
    jitter: float


def backward_rows(t: FloatArray) -> npt.NDArray[np.int64]:
    """Rows whose time is not later than that of the row before, (K,)."""
    return np.flatnonzero(np.diff(t) <= 0) + 1


def _round_figures(value: float, figures: int) -> float:
    return float(f"{value:.{figures}g}")


def _placed(
    t: FloatArray, dt: float, blocks: tuple[tuple[int, int], ...]
) -> tuple[npt.NDArray[np.int64], float]:
    """(slots, largest shift [s]) of the stamps on a grid of step dt, one phase per block."""
    slots = np.zeros(t.size, dtype=np.int64)
    worst = 0.0
    for start, stop in blocks:
        steps = np.maximum(np.rint(np.diff(t[start:stop]) / dt), 1.0).astype(np.int64)
        slots[start:stop] = np.concatenate([[0], np.cumsum(steps)])
        offset = t[start:stop] - dt * slots[start:stop]
        worst = max(worst, 0.5 * float(np.ptp(offset)))
    return slots, worst


def read_clock(t: FloatArray, *, max_gap: float) -> Clock:
    """Describe increasing stamps `t` (N >= 2) [s]; steps longer than `max_gap` [s] end a block.

    Sample times that are round figures are preferred, so that flights of one rate get the same
    sample time exactly.
    """
    steps = np.diff(t)
    middle = float(np.median(steps))
    cuts = np.flatnonzero(steps > max(max_gap, 1.5 * middle)) + 1
    edges = [0, *cuts.tolist(), t.size]
    blocks = tuple(itertools.pairwise(edges))
    inside = steps[steps <= max(max_gap, 1.5 * middle)]
    low, high = np.percentile(inside, [1, 99])
    single = inside[(inside > 0.5 * middle) & (inside < 1.5 * middle)]
    mean = float(single.mean()) if single.size else middle  # steps of all sizes: rows out of order
    rate = 1.0 / mean
    candidates = [
        1.0 / _round_figures(rate, 2),
        1.0 / _round_figures(rate, 3),
        _round_figures(mean, 3),
    ]
    long = max(blocks, key=lambda b: b[1] - b[0])
    counted, _ = _placed(t, mean, (long,))
    if long[1] - long[0] > 2:
        slope = np.polyfit(counted[long[0] : long[1]], t[long[0] : long[1]] - t[long[0]], 1)[0]
        candidates += [_round_figures(float(slope), 5), float(slope)]
    candidates.append(mean)
    for dt in candidates:
        slots, shift = _placed(t, dt, blocks)
        if shift <= UNIFORM_SHIFT * dt:
            return Clock(
                dt=dt,
                uniform=True,
                blocks=blocks,
                slots=slots,
                shift=shift,
                jitter=float(high - low) / dt,
            )
    return Clock(
        dt=mean,
        uniform=False,
        blocks=blocks,
        slots=slots,
        shift=shift,
        jitter=float(high - low) / mean,
    )
