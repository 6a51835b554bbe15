"""How a vector of free numbers moves a linear model: the seam between the Gauss-Newton solver and the model class.

`Free` is the full model without redundancy: data-driven local coordinates (McKelvey, Helmersson and Ribarits 2004,
Automatica 40(9)). Steps are taken orthogonally to the directions that only change the state coordinates, and the
coordinates are renewed at every step, so that no canonical form (and none of its bad conditioning) is needed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from greybox.estimation.linear.predictor import from_full_vector, full_vector
from greybox.model.matrices import Matrices
from greybox.symbolic import FloatArray


class Parametrisation(Protocol):
    """A point of a model class, and the directions in which it may move."""

    @property
    def system(self) -> Matrices:
        """The matrices at this point."""

    def tangent(self) -> FloatArray:
        """Derivative of the full vector (`predictor.full_vector`) along each free direction: (q, n_free)."""

    def moved(self, step: FloatArray) -> Parametrisation:
        """The point after a step (n_free,) along the tangent."""


@dataclass(frozen=True, kw_only=True)
class Free:
    """All matrices free. `noise_model` False holds K = 0 (output error), `feedthrough` False holds D = 0."""

    system: Matrices
    noise_model: bool = True
    feedthrough: bool = True

    @property
    def free(self) -> np.ndarray:
        """Which entries of the full vector are free: booleans (q,)."""
        n, m, p = self.system.sizes
        rows = np.ones((n, n + m + p), dtype=bool)
        rows[:, n + m :] = self.noise_model
        return np.concatenate([rows.ravel(), np.ones(p * n, dtype=bool), np.full(p * m, self.feedthrough)])

    @property
    def dimension(self) -> int:
        """Number of free directions: n (m + 2p) + p m for the full innovation model."""
        n, m, p = self.system.sizes
        return n * (m + p + (p if self.noise_model else 0)) + (p * m if self.feedthrough else 0)

    def tangent(self) -> FloatArray:
        """Orthonormal basis of the free directions that are orthogonal to the similarity orbit."""
        free = self.free
        orbit = similarity_directions(self.system)[free]
        q, _ = np.linalg.qr(orbit, mode="complete")
        out = np.zeros((len(free), self.dimension))
        out[free] = q[:, orbit.shape[1] :]
        return out

    def moved(self, step: FloatArray) -> Free:
        """The point after the step; its own tangent is renewed when it is asked for."""
        vector = full_vector(self.system) + self.tangent() @ step
        return Free(
            system=from_full_vector(vector, self.system.sizes),
            noise_model=self.noise_model,
            feedthrough=self.feedthrough,
        )


def similarity_directions(system: Matrices) -> FloatArray:
    """Changes of the full vector under x' = (I + T) x for T = each unit matrix: (q, n^2); they change no output."""
    n, m, p = system.sizes
    f, g, c = system.predictor, system.predictor_input, system.c
    width = n + m + p
    out = np.zeros((n * width + p * n + p * m, n * n))
    for i in range(n):
        for j in range(n):
            rows = np.zeros((n, width))
            rows[i, :n] = f[j]
            rows[:, j] -= f[:, i]
            rows[i, n:] = g[j]
            change = np.zeros((p, n))
            change[:, j] = -c[:, i]
            out[:, i * n + j] = np.concatenate([rows.ravel(), change.ravel(), np.zeros(p * m)])
    return out
