"""Whether a series changed for good: a step that stays, or a drift from its start to its end.

Under a memory of first order, what comes new in a value is independent of all before. A step is one
that jumps, as none does by chance, after which the values do not come back as those after a gust do;
both are Student's t. How often a series that only remembers drifts as far is counted in drawn ones,
of every memory that it may have. A change may also be that of a cause which changes meanwhile.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from greybox.statistics.distributions import fisher_tail
from greybox.statistics.evidence import FELT
from greybox.symbolic import FloatArray

TRIM = 0.15
"""Share of the series before the first step that is looked for, and after the last (Andrews 1993,
Econometrica 61(4))."""
FEWEST = 12
"""Values that tell a change from a memory."""
MOST = 60
"""Values that are needed: a longer series is looked at in means."""
FALSE = 0.01
"""How often one of all series that are looked at may seem to change without a change."""
LONGEST = 0.98
"""Memory, from one value to the next, that is not told from one for ever."""
MEMORIES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, LONGEST)
"""Those that are tried: what a drift leaves of a short series looks as if it had less."""
DOUBT = 0.1
"""A memory of which less than this share of the series seem to have as little is not tried."""


@dataclass(frozen=True, kw_only=True)
class Change:
    """From `at` values after the first on (None: drifting from the first value to the last) the
    series is higher by `size`; `p` of series without a change seem to change as much."""

    at: float | None
    size: float
    p: float


def lasting_change(y: FloatArray, memory: float, tests: int = 1) -> Change | None:
    """The change of a series (m,) that is told from what passes; None where there is none.
    `memory`: least correlation of a value with the one before; `tests`: of how many series this is
    one."""
    if len(y) < FEWEST or not np.ptp(y) > 0:
        return None
    found = [c for c in (_step(y, memory), _drift(y, memory, tests)) if c is not None]
    best = min(found, key=lambda c: c.p, default=None)
    # Two kinds of change are looked for.
    return best if best is not None and 2 * tests * best.p <= FALSE else None


@dataclass(frozen=True, kw_only=True, eq=False)
class Cause:
    """What a series may be a function of: z (m, k), of which differences far below `least` change
    nothing."""

    z: FloatArray
    least: float = 0.0


def beyond(y: FloatArray, change: Change, causes: Sequence[Cause]) -> bool:
    """Whether a series (m,) changes although it may be a function of any one of the `causes`.

    Nobody knows the function: a Gaussian process as smooth as the cause is wide, and as large as
    the change. Where a cause is the same before and after, or what comes in each of both does not
    go with it, time is left to explain the change; where each has its own, nothing tells them apart.
    """
    m, unit = len(y), abs(change.size)
    y, change = y / unit, replace(change, size=change.size / unit)
    place = np.arange(m)
    shape = place / (m - 1.0)
    if change.at is not None:
        shape = np.clip(place + 1.0 - change.at, 0.0, 1.0)
    both = np.column_stack([np.ones(m), shape])
    rest = y - both @ np.linalg.lstsq(both, y, rcond=None)[0]
    apart = np.abs(np.subtract.outer(place, place))
    noise = (rest.var() + 1e-12 * y.var()) * _memory(rest) ** apart
    for cause in causes:
        z = cause.z - cause.z.mean(axis=0)
        width = max(float((z**2).sum(axis=1).mean()), cause.least**2)
        if not width > 0:
            continue
        square = ((z[:, None] - z[None]) ** 2).sum(axis=2)
        whole = noise + np.exp(-0.5 * square / width)
        spread = np.linalg.inv(both.T @ np.linalg.solve(whole, both))
        found = spread @ (both.T @ np.linalg.solve(whole, y))
        if found[1] * np.sign(change.size) <= FELT * np.sqrt(spread[1, 1]):
            return False
    return True


def _memory(*parts: FloatArray) -> float:
    """Correlation of a value with the one before, of parts with a mean of their own; an estimate
    from few is too small (Kendall 1954, Biometrika 41)."""
    rest = [p - p.mean() for p in parts]
    power = sum(float(r @ r) for r in rest)
    told = sum(float(r[1:] @ r[:-1]) for r in rest) / power if power > 0 else 0.0
    return float(np.clip(told + (1.0 + 4.0 * told) / sum(map(len, parts)), 0.0, LONGEST))


def _step(y: FloatArray, memory: float) -> Change | None:
    """The step that jumps most surely, of those that stay. The value at the step is of both
    levels."""
    m = len(y)
    edge = int(np.ceil(TRIM * m))
    places = range(edge, m - edge)
    best, at = 0.0, None
    for k in places:
        own = _memory(y[:k], y[k + 1 :])
        # A memory that is known may be long because of the step: whether that stays tells its own.
        jump = _jump(y, k, max(min(memory, LONGEST), own))[0]
        if abs(jump) > abs(best) and _jump(y, k, own)[1]:
            best, at = jump, k
    if at is None:
        return None
    low, high = y[:at].mean(), y[at + 1 :].mean()
    # How much of the value at the step is of the level before.
    share = np.clip((high - y[at]) / (high - low), 0.0, 1.0) if high != low else 0.5
    p = min(1.0, len(places) * float(fisher_tail(best**2, 1, m - 5)))
    return Change(at=at + float(share), size=float(high - low), p=p)


def _jump(y: FloatArray, k: int, memory: float) -> tuple[float, bool]:
    """(Student's t of the jump from value k - 1 to k + 1, with m - 5 degrees of freedom, whether
    the level stays away on that side)."""
    new = y[1:] - memory * y[:-1]
    before, after = new[: k - 1], new[k + 1 :]
    low, n_low, n_high = before.mean(), len(before), len(after)
    up = after.mean() - low
    free = n_low + n_high - 2
    rest = float(((before - low) ** 2).sum() + ((after - after.mean()) ** 2).sum())
    spread = np.sqrt(rest / free) + np.finfo(float).tiny
    width = np.sqrt(1 + memory**2 + (1 + memory) ** 2 / n_low)
    jump = float(new[k] + memory * new[k - 1] - (1 + memory) * low) / (width * spread)
    stay = up / (spread * np.sqrt(1 / n_low + 1 / n_high)) * np.sign(jump)
    return jump, bool(stay > 0 and fisher_tail(stay**2, 1, free) <= 2 * FALSE)


def _drift(y: FloatArray, memory: float, tests: int) -> Change | None:
    """The drift, where it is told from what a memory does; its standard error is that of a series
    with the memory that the drift leaves."""
    told, size, left = _line(y)
    p, count = 0.0, int(np.ceil(8 * tests / FALSE / 1000)) * 1000
    for rho in sorted({min(memory, LONGEST), *(r for r in MEMORIES if r > memory)}):
        usual, memories = _usual(len(y), float(np.ceil(50 * rho) / 50), count)
        if rho > memory and (memories <= left).mean() < DOUBT:
            break
        p = max(p, float(1 + (usual >= abs(told)).sum()) / (count + 1))
        if 2 * tests * p > FALSE:
            return None
    return Change(at=None, size=float(size), p=p)


def _line(y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Of series (..., m): the drift over its standard error, the drift, and the memory that it
    leaves."""
    m = y.shape[-1]
    line = np.linspace(-0.5, 0.5, m)
    y = y - y.mean(axis=-1, keepdims=True)
    size = y @ line / (line @ line)
    rest = y - size[..., None] * line
    power = (rest**2).sum(axis=-1) + np.finfo(float).tiny
    memory = np.clip((rest[..., 1:] * rest[..., :-1]).sum(axis=-1) / power, 0.0, LONGEST)
    variance = power / (m - 2) * (1.0 + memory) / (1.0 - memory) / (line @ line)
    return size / np.sqrt(variance), size, memory


@functools.lru_cache(maxsize=24)
def _usual(m: int, memory: float, count: int) -> tuple[FloatArray, FloatArray]:
    """How far (count,) drawn series of m values with this memory drift, over its standard error,
    and the memory that this leaves them."""
    rng, share = np.random.default_rng(0), np.sqrt(1.0 - memory**2)
    found = []
    for _ in range(count // 1000):
        y = rng.standard_normal((1000, m))
        for i in range(1, m):
            y[:, i] = memory * y[:, i - 1] + share * y[:, i]
        told, _, left = _line(y)
        found.append((np.abs(told).astype(np.float32), left.astype(np.float32)))
    return np.concatenate([t for t, _ in found]), np.concatenate([m for _, m in found])
