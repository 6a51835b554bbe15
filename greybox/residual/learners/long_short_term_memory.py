"""A long short-term memory over earlier commands with a Bayesian last layer: a learner that
remembers, by gates.

One layer runs from the oldest command of `MEMORY` to the present one, from an empty state
(Hochreiter and Schmidhuber 1997, Neural Computation 9(8); forget gate of Gers et al. 2000, Neural
Computation 12(10)):

    i, f, o = sigmoid(W u[t] + R h[t-1] + b),   g = tanh(W u[t] + R h[t-1] + b),
    c[t] = f c[t-1] + i g,   h[t] = o tanh(c[t])

Its state begins anew at every sample, so that nothing has to be estimated: the commands of the
window are the state of an export.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

from greybox.residual.learners.sequence import CHANNELS, SequenceLearner, SequenceNetwork, Tanh
from greybox.symbolic import FloatArray, Numeric

GATES = ("enter", "forget", "fresh", "leave")
"""In the order of their rows."""


class Step(NamedTuple):
    """One sample: input, earlier h, gates, earlier c (None at the oldest one) and tanh(c)."""

    input: Numeric
    output: Numeric | None
    gates: tuple[Numeric, Numeric, Numeric, Numeric]
    memory: Numeric | None
    bent: Numeric


@dataclass(frozen=True, kw_only=True)
class Recurrence(SequenceNetwork[list[Step]]):
    """The memory is the last h[t]."""

    def memory_shapes(self) -> list[tuple[int, int]]:
        """W, R and b of all gates, one below the other."""
        rows = len(GATES) * CHANNELS
        return [(rows, len(self.taps[0])), (rows, CHANNELS), (rows, 1)] if self.taps else []

    def begin(self, w: Sequence[FloatArray]) -> None:
        """Nothing is forgotten to begin with (Jozefowicz et al. 2015, ICML)."""
        if self.taps:
            w[2][CHANNELS : 2 * CHANNELS] += 1.0

    def remembered(
        self, taps: Sequence[Numeric], w: Sequence[Numeric], tanh: Tanh
    ) -> tuple[Numeric, list[Step]]:
        """Keeps every sample, the oldest first."""
        h: Numeric | None = None
        c: Numeric | None = None
        steps: list[Step] = []
        for u in reversed(taps):
            sums = w[0] @ u + w[2] + (0.0 if h is None else w[1] @ h)
            parts = [sums[k * CHANNELS : (k + 1) * CHANNELS, :] for k in range(len(GATES))]
            enter, forget, leave = (0.5 + 0.5 * tanh(0.5 * parts[k]) for k in (0, 1, 3))
            fresh = tanh(parts[2])
            after = enter * fresh + (0.0 if c is None else forget * c)
            bent = tanh(after)
            steps.append(Step(u, h, (enter, forget, fresh, leave), c, bent))
            h, c = leave * bent, after
        return h, steps

    def back(
        self, kept: list[Step], into: FloatArray, w: Sequence[FloatArray], g: Sequence[FloatArray]
    ) -> None:
        """From the present sample to the oldest one."""
        of_h, of_c = into, np.zeros_like(into)
        for u, h, (enter, forget, fresh, leave), c, bent in reversed(kept):
            of_c = of_c + of_h * leave * (1 - bent**2)
            before = np.zeros_like(of_c) if c is None else c
            sums = np.concatenate(
                [
                    of_c * fresh * enter * (1 - enter),
                    of_c * before * forget * (1 - forget),
                    of_c * enter * (1 - fresh**2),
                    of_h * bent * leave * (1 - leave),
                ]
            )
            g[0][:] += sums @ u.T
            g[2][:] += sums.sum(axis=1, keepdims=True)
            if h is None:
                break
            g[1][:] += sums @ h.T
            of_h, of_c = w[1].T @ sums, of_c * forget


class LongShortTermMemory(SequenceLearner):
    """`greybox learn --learner lstm`."""

    name: ClassVar[str] = "lstm"
    label: ClassVar[str] = "recurrence"
    network: ClassVar[type[SequenceNetwork]] = Recurrence
