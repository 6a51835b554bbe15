"""How long work will still take, in the words of a person."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

FIRST = 2.0
"""Seconds of work before which nothing is said: shorter stages end by themselves."""
ARRIVED = 1e-6
"""Expected decrease of the cost at which a solver stops (as `LevenbergMarquardt.tolerance`)."""
LAST = 4
"""Iterations from which the rate of convergence is read."""


def in_words(seconds: float) -> str:
    """About how long, rounded as a person would."""
    if seconds < 90:
        return f"about {max(10, round(seconds, -1)):.0f} s left"
    if seconds < 5400:
        return f"about {seconds / 60:.0f} min left"
    return f"about {seconds / 3600:.1f} h left"


class TimeLeft:
    """Says how long is left from the share that is done. `clock` gives seconds."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._began = clock()
        self._steps: list[tuple[float, float]] = []

    def after(self, share: float) -> str:
        """", about ... left" when `share` (0 to 1) is done at the pace so far, "" where it is too early to tell."""
        spent = self._clock() - self._began
        if spent < FIRST or not 0.02 <= share < 1.0:
            return ""
        return f", {in_words(spent / share * (1 - share))}"

    def after_step(self, iteration: int, decrement: float) -> str:
        """The same of a solver by its expected decrease, which falls by about the same factor each iteration when it
        comes near its end; "" while it does not fall, and where it is too early to tell."""
        if iteration <= 1:
            self._steps.clear()
        now = self._clock()
        self._steps.append((now, math.log(max(decrement, 1e-300))))
        if now - self._began < FIRST or len(self._steps) < LAST or not decrement > ARRIVED:
            return ""
        (then, high), (_, low) = self._steps[-LAST], self._steps[-1]
        if not high - low > 0.1 * (LAST - 1):
            return ""
        return f", {in_words((now - then) * (low - math.log(ARRIVED)) / (high - low))}"
