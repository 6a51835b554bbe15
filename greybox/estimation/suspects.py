"""Which of two numbers is off, where flights show little but their ratio.

A mass that is held beside a thrust that is estimated: the thrust that comes out may be the craft's,
or the mass is not. Flights cannot say. What was stated of both can, and a scale.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Protocol

from greybox.model.identified import IdentifiedModel

HOW = {"mass": "weigh it"}
"""How to tell what a number is, where that is not to measure it."""
DENIED = 4.0
"""Standard deviations from a stated number beyond which flights deny it: a Gaussian prior is that
wrong once in 16 000."""
ALIKE = 0.5
"""Power of the held number from which an estimate that goes with it tells it."""


class Stated(Protocol):
    """What is asked of an estimate."""

    @property
    def value(self) -> float:
        """Estimate in its unit."""

    @property
    def prior(self) -> tuple[float, float] | None:
        """Mean and standard deviation, None where there is no prior."""


def suspects(model: IdentifiedModel, found: Mapping[str, Stated]) -> dict[str, str]:
    """Estimate -> in words, where it denies what was stated of it, what of a held number would do
    the same. An estimate that is as it was stated accuses no other number. Factors count: of each
    held number the estimate is asked that was stated best for one of them."""
    units = {d.name: d.unit for d in model.dynamics.parameters}
    out: dict[str, str] = {}
    for held, (error, moves) in model.considered.items():
        value = model.values[held]
        told = [
            (e.prior[1] / e.prior[0] / power, power, n)
            for n, e in found.items()
            if e.prior is not None
            and 0.0 < e.prior[1] < math.inf
            and min(e.prior[0], e.value, value) > 0.0
            and (power := abs(moves.get(n, 0.0)) * value / e.value) > ALIKE
        ]
        if not told or not error > 0.0:
            continue
        share, power, name = min(told)
        e = found[name]
        assert e.prior is not None
        factor = math.log(e.value / e.prior[0]) / power
        if max(abs(factor) / share, abs(e.value - e.prior[0]) / e.prior[1]) <= DENIED:
            continue
        way = 1.0 if moves[name] > 0.0 else -1.0
        out[name] = (
            f"{e.prior[0]:.4g} was stated, {abs(factor) / share:.1f} sigma away; or {held} is "
            f"{value * math.exp(-way * factor):.4g} {units[held]}, "
            f"{abs(factor) * value / error:.1f} sigma away: {HOW.get(held, 'measure it')}"
        )
    return out
