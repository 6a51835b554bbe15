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

from greybox.discovery.rules import RULES
from greybox.statistics.betting import betting
from greybox.symbolic import FloatArray
from greybox.validation.gap import HeldOutErrors


@dataclass(frozen=True, kw_only=True)
class Worth:
    """`share` of the squared error that a name removes where it does most, in `group` at `horizon`
    [s] (0: one sample), of what can be `seen`: whether it is more than the squared error of one
    reading; `log_e` of the e-process over `seconds`."""

    share: float
    seen: bool
    group: str
    horizon: float
    log_e: float
    seconds: int

    @property
    def matters(self) -> bool:
        """Whether the name is worth anything."""
        return self.seen and self.share >= RULES.trace


def worth(without: HeldOutErrors, named: HeldOutErrors) -> Worth:
    """What a name removes of the errors `without` it."""
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
    changes = seconds(without, named)
    return Worth(
        share=float(best[1]),
        seen=best[0],
        group=best[2],
        horizon=best[3],
        log_e=betting(changes),
        seconds=int(changes.size),
    )


def seconds(without: HeldOutErrors, named: HeldOutErrors) -> FloatArray:
    """Per second of flight (hundred samples of one's own model), (old - new) / (old + new) of the
    squared error `RULES.fastest` to `RULES.longest` ahead, mean over groups and horizons."""
    rows: list[FloatArray] = []
    for (group, horizon), blocks in without.own.items():
        new = named.own.get((group, horizon), [])
        asked = RULES.fastest <= round(horizon / without.second, 6) <= RULES.longest
        if not asked or not blocks or len(new) != len(blocks):
            continue
        old = np.array([b.sum() for b in blocks])
        now = np.array([b.sum() for b in new])
        rows.append((old - now) / np.maximum(old + now, 1e-300))
    length = min((len(r) for r in rows), default=0)
    if not length:
        return np.zeros(0)
    return np.asarray(np.mean([r[:length] for r in rows], axis=0))
