"""Clock: how many samples have passed between two calls, whatever the caller's clock does.

Calls that come a little early or late even out. Where calls did not come, several samples have
passed. A clock that jumps back or by more than LATE is not followed: one sample has passed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

LATE = 0.25
"""A longer pause between two calls is a fault of the clock [s]."""
EARLY = 0.25
"""A call counts for another sample when it comes no more than this share of one too early for
it."""


@dataclass(kw_only=True, eq=False)
class Clock:
    """Time at a sample time `step` [s]; `note` gets the time of what is not as usual, and what."""

    step: float
    note: Callable[[float, str], None]
    _told: float = math.nan
    """What the caller said last [s]."""
    _jumped: float = 0.0
    """By how much its clock has jumped since it was first asked [s]."""
    _phase: float = 0.0
    """What is left of a sample, which counts at the next call."""

    @property
    def now(self) -> float:
        """Time of the last call [s], without what the clock has jumped; NaN before the first."""
        return self._told - self._jumped

    def passed(self, time: float) -> int:
        """Samples since the call before, at least 1; `time` [s] may be anything."""
        if math.isnan(self._told):
            self._told = time - self.step if math.isfinite(time) else 0.0
        gone = time - self._told
        if not -1e-9 <= gone <= LATE:
            if math.isfinite(gone):
                self._jumped += gone - self.step
                self._told = time
            else:
                self._told += self.step
            self._phase = 0.0
            self.note(self.now, "the clock jumps")
            return 1
        self._told = time
        self._phase += gone / self.step
        passed = max(1, int(self._phase + EARLY))
        self._phase = min(max(self._phase - passed, -1.0), 1.0)
        if passed > 1:
            self.note(self.now, "calls did not come")
        return passed
