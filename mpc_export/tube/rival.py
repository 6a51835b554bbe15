"""Rival: an estimate of the motion that owes nothing to the one in use. It takes over where it
explains the measurements far better.

A filter of constant gain comes back from an error only as fast as its gain, and a nonlinear one
from a large error not at all. So an estimate is denied as soon as a sensor is not believed at all
(gate.py), and until a whole pose surprises no more and the gate is as narrow as at first. While it
is denied, a sample that surprises begins another: at what is measured, at rest. It is carried on
beside it by the same filter. Its evidence is the sum of the log-likelihood ratios (Wald 1945,
Annals of Mathematical Statistics 16(2)). At a sample that it explains no better it is given up, and
the next begins another. So wrong measurements, which deny every estimate alike, change nothing. One
that takes over meets the gate of a flight's start.

A sensor that is doubted denies nothing: a wind or a weak rotor makes the estimate late, sample by
sample. What begins at measurements would be late the same way soon, and forget what was learned.

Of force and torque one sample says nothing. Two rivals begin: one with those of the estimate, if
rotors could hold against them, which takes over only where it explains clearly more, and one with
none. Of its motion, force and torque each is as unsure as the start of a flight is. Of those that
it keeps it is as unsure as the estimate besides: what denied that may have changed them, too.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from greybox.symbolic import FloatArray

CLEARLY = math.log(2.0)
"""Evidence, or surprise (`Gate.surprise`), that is clear: that of one number as far off as the gate
lets through."""
BELIEVED = math.log(1e6)
"""Evidence at which the rival takes over, a million to one: more than one sensor gives in one
sample."""


class Known(NamedTuple):
    """All that a filter knows at a sample: state x (n_x,), learned parameters theta (n_t,), how
    unsure (n_a, n_a) both are beyond the settled filter, and the steps (restless.py)."""

    x: FloatArray
    theta: FloatArray
    unsure: FloatArray
    steps: FloatArray


class Rival:
    """The estimate that may take over at the next sample, or None; and the evidence for it."""

    def __init__(self) -> None:
        self.known: Known | None = None
        self.evidence = 0.0

    def begins(self, known: Known) -> None:
        """At the measurements of a sample; one that is not finite does not."""
        if np.isfinite(known.x).all():
            self.known, self.evidence = known, 0.0

    def goes_on(self, known: Known, gained: float) -> None:
        """One sample later; gained: how much likelier the rival made that sample's measurements, as
        a logarithm."""
        self.evidence += gained
        self.known = known if gained > 0.0 and np.isfinite(known.x).all() else None

    @property
    def believed(self) -> bool:
        """Whether it is to take over."""
        return self.known is not None and self.evidence >= BELIEVED


def likelier(pushed: Rival, bare: Rival) -> Rival:
    """The rival that speaks for both, see above."""
    if bare.known is None:
        return pushed
    more = pushed.known is not None and pushed.evidence >= bare.evidence + CLEARLY
    return pushed if more else bare
