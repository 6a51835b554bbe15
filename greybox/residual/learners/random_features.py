"""Random Fourier features: a Gaussian process of a squared-exponential kernel, without training or
support points.

phi_i = sqrt(2/M) cos(w_i'x + b_i), w ~ N(0, I/l^2), b uniform: products phi(x)'phi(x') are the
kernel's values on average (Rahimi and Recht 2007, NIPS). A few length-scales l compete; the inputs
themselves are features too.
"""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca
import numpy as np

from greybox.residual.learners.learner import Features
from greybox.symbolic import Expr, FloatArray

LENGTHS = (1.0, 3.0)
"""Length-scales in standard deviations of an input."""


class RandomFeatures:
    """Cosines of random directions, and the inputs."""

    name = "random-features"

    def features(
        self, x: FloatArray, y: FloatArray, *, points: int, seed: int
    ) -> Mapping[str, Features]:
        """One candidate per length-scale."""
        rng = np.random.default_rng(seed)
        directions = rng.standard_normal((points, x.shape[1]))
        phases = rng.uniform(0, 2 * np.pi, points)

        def waves(length: float) -> Features:
            def phi(s: Expr) -> Expr:
                angle = ca.DM(directions / length) @ s + ca.DM(phases)
                return ca.vertcat(np.sqrt(2.0 / points) * ca.cos(angle), s / np.sqrt(x.shape[1]))

            return phi

        return {f"random features, length {length:g}": waves(length) for length in LENGTHS}
