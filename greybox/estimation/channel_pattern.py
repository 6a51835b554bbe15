"""Which channels a record usually has at which sample: channels that come at a lower rate repeat in a pattern."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from greybox.symbolic import BoolArray, FloatArray

LONGEST = 64
"""Samples of the longest pattern of channels that is looked for: 1.5 Hz in a 100 Hz log."""
REPEATS = 0.95
"""Share of the samples that have to repeat a pattern: fewer than one lost sample in twenty leaves it what it is."""


@dataclass(frozen=True, kw_only=True)
class Pattern:
    """Channels of a record that repeat: `there` (L, n_e), sample t has those of phase t mod L, as a rule."""

    there: BoolArray

    @property
    def length(self) -> int:
        """Number of samples L."""
        return len(self.there)


def pattern_of(mask: FloatArray) -> Pattern:
    """The shortest pattern that the channels `mask` (n, n_e) repeat: L up to `LONGEST`, in `REPEATS` of the samples; all
    channels that are ever there where they repeat none."""
    there = np.asarray(mask != 0)
    n = len(there)
    for length in range(1, min(LONGEST, n // 3) + 1):
        whole = n - n % length
        phases = there[:whole].reshape(-1, length, there.shape[1])
        usual = np.asarray(2 * phases.sum(axis=0) > len(phases))
        if (phases == usual).all(axis=2).mean() >= REPEATS and (usual.any() or not there.any()):
            return Pattern(there=usual)
    return Pattern(there=np.atleast_2d(there.any(axis=0)))
