"""Rival: an estimate of the motion that owes nothing to the one in use. It takes over where it
explains the measurements far better.

A filter of constant gain comes back from an error only as fast as its gain, and a nonlinear one
from a large error not at all. So where a sensor denies the estimate, another begins at what is
measured at that sample, at rest, and is carried on beside it. Its evidence is the sum of the
log-likelihood ratios (Wald 1945, Annals of Mathematical Statistics 16(2)). At a sample that it
explains no better it is given up, and the next that denies the estimate begins another. So wrong
measurements, which deny every estimate alike, change nothing.

Of force and torque one sample says nothing. Two rivals begin: one with those of the estimate, if
rotors could hold against them, which takes over only where it explains clearly more, and one with
none. Where a wind or a weak rotor denies the estimate sample by sample, a rival without them would
take over again and again, and they would never be learned.
"""

from __future__ import annotations

import math

import numpy as np

from greybox.symbolic import FloatArray

DENIED = math.log(2.0)
"""Surprise (`Gate.surprise`) of a sample that begins a rival: one number that is as far off as the
gate lets through."""
BELIEVED = math.log(1e6)
"""Evidence at which the rival takes over, a million to one: more than one sensor gives in one
sample."""


class Rival:
    """The estimate that may take over, (n_x,) for the next sample, or None; and the evidence for
    it."""

    def __init__(self) -> None:
        self.estimate: FloatArray | None = None
        self.evidence = 0.0

    def begins(self, estimate: FloatArray) -> None:
        """At the measurements of a sample; one that is not finite does not."""
        if np.isfinite(estimate).all():
            self.estimate, self.evidence = estimate, 0.0

    def goes_on(self, estimate: FloatArray, gained: float) -> None:
        """One sample later; gained: how much likelier the rival made that sample's measurements, as
        a logarithm."""
        self.evidence += gained
        self.estimate = estimate if gained > 0.0 and np.isfinite(estimate).all() else None

    @property
    def believed(self) -> bool:
        """Whether it is to take over."""
        return self.estimate is not None and self.evidence >= BELIEVED


def likelier(pushed: Rival, bare: Rival) -> Rival:
    """The rival that speaks for both, see above."""
    if bare.estimate is None:
        return pushed
    more = pushed.estimate is not None and pushed.evidence >= bare.evidence + DENIED
    return pushed if more else bare
