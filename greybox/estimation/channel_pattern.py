"""Which channels a record usually has at which sample: channels that come at a lower rate repeat in
a pattern."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from greybox.symbolic import BoolArray, FloatArray

LONGEST = 64
"""Samples of the longest pattern of channels that is looked for: 1.5 Hz in a 100 Hz log."""
REPEATS = 0.95
"""Share of the samples that have to repeat a pattern: fewer than one lost sample in twenty leaves
it what it is."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Pattern:
    """Channels of a record that repeat: `there` (L, n_e), sample t has those of phase t mod L, as a
    rule."""

    there: BoolArray

    @property
    def length(self) -> int:
        """Number of samples L."""
        return len(self.there)

    def at(self, n: int) -> BoolArray:
        """Which channels are usually there at n samples, (n, n_e)."""
        return self.there[np.arange(n) % self.length]

    @cached_property
    def runs(self) -> tuple[tuple[int, int], ...]:
        """(first phase, number of phases) of samples in a row with the same channels."""
        change = np.flatnonzero((self.there[1:] != self.there[:-1]).any(axis=1)) + 1
        ends = [0, *map(int, change), self.length]
        return tuple((a, b - a) for a, b in pairwise(ends))

    @cached_property
    def parts(self) -> tuple[tuple[int, int], ...]:
        """The runs in parts of 1, 2, 4, ... phases: after a sample that tells much things change
        fast."""
        found = []
        for begin, size in self.runs:
            end, part = begin + size, 1
            while begin < end:
                found.append((begin, min(part, end - begin)))
                begin, part = begin + part, 2 * part
        return tuple(found)

    @cached_property
    def ahead(self) -> int:
        """Samples to the phase from which on patterns that are the same but for their phase look
        alike."""
        turned = [np.roll(self.there, -k, axis=0).tobytes() for k in range(self.length)]
        return min(range(self.length), key=turned.__getitem__)

    def turned(self, by: int) -> Pattern:
        """The pattern from phase `by` on."""
        return self if by == 0 else Pattern(there=np.roll(self.there, -by, axis=0))


def pattern_of(mask: FloatArray) -> Pattern:
    """The shortest pattern that the channels `mask` (n, n_e) repeat: L up to `LONGEST`, in
    `REPEATS` of the samples; all channels that are ever there where they repeat none."""
    there = np.asarray(mask != 0)
    n = len(there)
    for length in range(1, min(LONGEST, n // 3) + 1):
        whole = n - n % length
        phases = there[:whole].reshape(-1, length, there.shape[1])
        usual = np.asarray(2 * phases.sum(axis=0) > len(phases))
        if (phases == usual).all(axis=2).mean() >= REPEATS and (usual.any() or not there.any()):
            return Pattern(there=usual)
    return Pattern(there=np.asarray(there.any(axis=0, keepdims=True)))
