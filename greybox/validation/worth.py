"""Worth: what a name is good for on flights, and the e-process of two forecasters.

The share of the squared error that a name removes, in its best channel group and horizon, one step
to a second ahead. What it removes must also be more than the error of a single reading there: a
share of next to nothing is nothing, and where all else is exact another integrator has a share.
Physics alone foretells: the unnamed force and torque, which make up for a missing name after a
second of flight, are set to zero at the start of every prediction.

When every model is wrong a likelihood ratio tests models that nobody believes. Beside it stands the
e-process of the hypothesis that the name does not improve what is foretold on average (Choe and
Ramdas, Operations Research 2024, arXiv:2110.00115): the relative change of the squared error of
every second, bounded by one, is bet on (Waudby-Smith and Ramdas 2024, JRSS B 86(1)).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from greybox.statistics.betting import betting
from greybox.statistics.blocks import clearly
from greybox.symbolic import FloatArray
from greybox.validation.against import TRACE
from greybox.validation.gap import HeldOutErrors

Span = tuple[float, float]
"""Shortest and longest horizon [s], or hundreds of samples of one's own model."""


@dataclass(frozen=True, kw_only=True)
class Worth:
    """`share` of the squared error that a name removes where it does most, in `group` at `horizon`
    [s] (0: one sample), of what can be `seen`: whether it is more than the squared error of one
    reading; `log_e` of the e-process over `seconds`; `harms`: the mean of their changes is below
    zero by two standard errors."""

    share: float
    seen: bool
    group: str
    horizon: float
    log_e: float
    seconds: int
    harms: bool = False

    @property
    def matters(self) -> bool:
        """Whether the name is worth anything."""
        return self.seen and self.share >= TRACE


def worth(without: HeldOutErrors, named: HeldOutErrors, span: Span) -> Worth:
    """What a name removes of the errors `without` it; within `span` the forecasters are compared."""
    best = (False, -np.inf, "", 0.0)
    for key, blocks in without.own.items():
        new = named.own.get(key, [])
        size = sum(b.size for b in blocks)
        if not size or len(new) != len(blocks):
            continue
        old = sum(float(b.sum()) for b in blocks)
        removed = old - sum(float(b.sum()) for b in new)
        if old > 0:
            best = max(best, (removed > size * named.reading.get(key[0], 0.0), removed / old, *key))
    changes = seconds(without, named, span)
    return Worth(
        share=float(best[1]),
        seen=best[0],
        group=best[2],
        horizon=best[3],
        log_e=betting(changes),
        seconds=int(changes.size),
        harms=clearly(-changes),
    )


def clearly_smaller(changes: FloatArray, least: float) -> bool:
    """Whether errors whose changes are those of `seconds` are clearly smaller, by the `least` share
    of the squared error on average."""
    return clearly(changes) and float(changes.mean()) > least / (2.0 - least)


def seconds(without: HeldOutErrors, named: HeldOutErrors, span: Span) -> FloatArray:
    """Per second of flight (hundred samples of one's own model), (old - new) / (old + new) of the
    squared error within `span` ahead, mean over groups and horizons."""
    rows: list[FloatArray] = []
    for (group, horizon), blocks in without.own.items():
        new = named.own.get((group, horizon), [])
        asked = span[0] <= round(horizon / without.second, 6) <= span[1]
        if not asked or not blocks or len(new) != len(blocks):
            continue
        old = np.array([b.sum() for b in blocks])
        now = np.array([b.sum() for b in new])
        rows.append((old - now) / np.maximum(old + now, 1e-300))
    length = min((len(r) for r in rows), default=0)
    if not length:
        return np.zeros(0)
    return np.asarray(np.mean([r[:length] for r in rows], axis=0))
