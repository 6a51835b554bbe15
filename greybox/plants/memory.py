"""What the sensors would have read a short while ago: for channels that arrive late."""

from __future__ import annotations

from greybox.plants.vectors import Number

Reading = list[Number]


class Memory:
    """Noise-free readings over the last `span` [s], linear inside every integration step and free
    to jump between two.

    Commands make the specific force jump between steps, so that each step keeps its reading at both
    of its ends.
    """

    def __init__(self, span: float, first: Reading) -> None:
        self._span = span
        self._steps: list[tuple[float, float, Reading, Reading]] = [
            (float("-inf"), 0.0, first, first)
        ]

    def keep(self, begin: float, end: float, first: Reading, last: Reading) -> None:
        """Add the step from `begin` to `end` [s] with the readings at its two ends."""
        self._steps.append((begin, end, first, last))
        old = end - self._span - 1e-9
        while self._steps[0][1] < old:
            del self._steps[0]

    def at(self, time: float) -> Reading:
        """The reading at `time` [s]; at a jump the one after it; before the flight the first, after
        the end the last."""
        for begin, end, first, last in reversed(self._steps):
            if time >= begin - 1e-12:
                if begin == float("-inf"):
                    return first
                share = min((time - begin) / (end - begin), 1.0)
                return [a + share * (b - a) for a, b in zip(first, last)]
        return self._steps[0][2]
