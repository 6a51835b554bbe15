"""A deep ensemble: several small networks, each with a last layer of its own; where they disagree
nobody knows.

Networks as in `greybox.residual.learners.neural`, from different starts. Each is fitted through the
physics on its own; what is learned is their mean, and its variance that of the mixture
(Lakshminarayanan, Pritzel and Blundell 2017, NIPS).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from greybox.residual.learners.learner import Features
from greybox.residual.learners.neural import ROWS, trained
from greybox.symbolic import FloatArray

MEMBERS = 5
"""Networks, as in the source."""


class DeepEnsemble:
    """Networks from different starts that share the number of features."""

    name = "ensemble"
    ensemble = True
    """What is offered does not compete: it is fitted one by one and averaged."""

    def features(
        self, x: FloatArray, y: FloatArray, *, points: int, seed: int
    ) -> Mapping[str, Features]:
        """One network per member, on rows of its own where there are many."""
        units, rng = max(4, points // MEMBERS), np.random.default_rng(seed)
        rows = [rng.permutation(len(x))[:ROWS] for _ in range(MEMBERS)]
        return {
            f"network {k + 1}": trained(x[at], y[at], units=units, seed=seed + k)
            for k, at in enumerate(rows)
        }
