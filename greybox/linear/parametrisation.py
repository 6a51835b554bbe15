"""How a vector of free numbers moves a linear model: the seam between the Gauss-Newton solver and
the model class.

`Free` is the full model without redundancy: data-driven local coordinates (McKelvey, Helmersson and
Ribarits 2004, Automatica 40(9)). Steps are taken across the directions that only change the state
coordinates, orthogonally to them in balanced coordinates, and both are renewed at every step, so
that no canonical form (and none of its bad conditioning) is needed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from greybox.linear.predictor import Modes, from_full_vector, full_vector
from greybox.model.matrices import Matrices
from greybox.symbolic import FloatArray


class Parametrisation(Protocol):
    """A point of a model class, and the directions in which it may move."""

    @property
    def system(self) -> Matrices:
        """The matrices at this point."""

    def tangent(self) -> FloatArray:
        """Derivative of the full vector (`predictor.full_vector`) along each free direction: (q,
        n_free)."""

    def moved(self, step: FloatArray) -> Parametrisation:
        """The point after a step (n_free,) along the tangent."""


@dataclass(frozen=True, kw_only=True)
class Free:
    """All matrices free. `noise_model` False holds K = 0 (output error), `feedthrough` False holds
    D = 0."""

    system: Matrices
    noise_model: bool = True
    feedthrough: bool = True

    @property
    def free(self) -> np.ndarray:
        """Which entries of the full vector are free: booleans (q,)."""
        n, m, p = self.system.sizes
        rows = np.ones((n, n + m + p), dtype=bool)
        rows[:, n + m :] = self.noise_model
        return np.concatenate(
            [rows.ravel(), np.ones(p * n, dtype=bool), np.full(p * m, self.feedthrough)]
        )

    @property
    def dimension(self) -> int:
        """Number of free directions: n (m + 2p) + p m for the full innovation model."""
        n, m, p = self.system.sizes
        return n * (m + p + (p if self.noise_model else 0)) + (p * m if self.feedthrough else 0)

    def tangent(self) -> FloatArray:
        """Basis of the free directions across the similarity orbit, orthonormal in balanced
        coordinates of the predictor."""
        return self._tangent

    @cached_property
    def _tangent(self) -> FloatArray:
        n, m, p = self.system.sizes
        t = balancing(self.system)
        inverse = np.linalg.inv(t)
        free = self.free
        orbit = similarity_directions(self.system.transformed(t))[free]
        q, _ = np.linalg.qr(orbit, mode="complete")
        d = self.dimension
        plain = np.zeros((len(free), d))
        plain[free] = q[:, orbit.shape[1] :]
        width, first = n + m + p, n * (n + m + p)
        rows = (inverse @ plain[:first].reshape(n, width * d)).reshape(n, width, d)
        rows[:, :n] = np.matmul(t.T, rows[:, :n])
        c = np.matmul(t.T, plain[first : first + p * n].reshape(p, n, d))
        return np.concatenate([rows.reshape(first, d), c.reshape(p * n, d), plain[first + p * n :]])

    def moved(self, step: FloatArray) -> Free:
        """The point after the step; its own tangent is renewed when it is asked for."""
        vector = full_vector(self.system) + self.tangent() @ step
        return Free(
            system=from_full_vector(vector, self.system.sizes),
            noise_model=self.noise_model,
            feedthrough=self.feedthrough,
        )


def balancing(system: Matrices) -> FloatArray:
    """T (n, n) for which x' = T x is balanced for the predictor [u, y] -> y_hat (Moore 1981); I
    where modes coincide.

    Steps taken in these coordinates bend least: in those of a bad start an iteration takes several
    times as many. The Gramians have a closed form in modal coordinates. Hankel values below 1e-6 of
    the largest are raised to that.
    """
    f = system.predictor
    modes = Modes(f)
    values, v, w = modes.values, modes.vectors, modes.inverse
    if not modes.usable or not np.abs(values).max() < 1.0:
        return np.eye(len(f))
    g, c = w @ system.predictor_input, system.c @ v
    overlap = 1.0 - values[:, None] * values[None].conj()
    reach = _root((v @ (g @ g.conj().T / overlap) @ v.conj().T).real)
    observe = _root((w.conj().T @ (c.conj().T @ c / overlap.conj()) @ w).real)
    left, hankel, _ = np.linalg.svd(observe.T @ reach)
    t = (observe @ left / np.sqrt(np.maximum(hankel, 1e-6 * max(float(hankel[0]), 1e-300)))).T
    return t if np.linalg.cond(t) < 1e8 else np.eye(len(f))


def _root(gramian: FloatArray) -> FloatArray:
    """R with R R' = the Gramian, small negative eigenvalues raised."""
    values, vectors = np.linalg.eigh((gramian + gramian.T) / 2)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 1e-12 * max(float(values[-1]), 1e-300))))


def similarity_directions(system: Matrices) -> FloatArray:
    """Changes of the full vector under x' = (I + T) x for T = each unit matrix: (q, n^2); they
    change no output."""
    n, m, p = system.sizes
    rows = np.hstack([system.predictor, system.predictor_input])
    width, each = n + m + p, np.arange(n)
    change = np.zeros((n, width, n, n))
    change[each, :, each] = rows.T
    change[:, each, :, each] -= system.predictor
    out = np.zeros((p, n, n, n))
    out[:, each, :, each] = -system.c
    return np.vstack(
        [change.reshape(n * width, n * n), out.reshape(p * n, n * n), np.zeros((p * m, n * n))]
    )
