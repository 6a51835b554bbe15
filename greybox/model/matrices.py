"""Matrices: the five matrices of a discrete linear model in innovation form, and the algebra that
belongs to them.

x[k+1] = A x[k] + B u[k] + K e[k],  y[k] = C x[k] + D u[k] + e[k],  cov(e) = Lambda (Ljung 1999, equation 4.91).
The predictor is the same model driven by data: x[k+1] = (A - KC) x[k] + (B - KD) u[k] + K y[k].
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.linalg as sla

from greybox.errors import ModelError
from greybox.symbolic import FloatArray


class Matrices(NamedTuple):
    """A (n, n), B (n, m), C (p, n), D (p, m), K (n, p). Plain numbers; names and units live in
    `LinearModel`."""

    a: FloatArray
    b: FloatArray
    c: FloatArray
    d: FloatArray
    k: FloatArray

    @property
    def order(self) -> int:
        """Number of states n."""
        return self.a.shape[0]

    @property
    def sizes(self) -> tuple[int, int, int]:
        """(n, m, p): states, inputs, outputs."""
        return self.a.shape[0], self.b.shape[1], self.c.shape[0]

    @property
    def predictor(self) -> FloatArray:
        """A - K C (n, n): the state matrix of the one-step predictor."""
        return self.a - self.k @ self.c

    @property
    def predictor_input(self) -> FloatArray:
        """[B - K D, K] (n, m + p): how the predictor takes u and y."""
        return np.hstack([self.b - self.k @ self.d, self.k])

    def transformed(self, t: FloatArray) -> Matrices:
        """The same system in the coordinates x' = T x; T (n, n) invertible."""
        inverse = np.linalg.inv(t)
        return Matrices(t @ self.a @ inverse, t @ self.b, self.c @ inverse, self.d, t @ self.k)

    def scaled(self, input_scale: FloatArray, output_scale: FloatArray) -> Matrices:
        """The system between u / input_scale and y / output_scale (arrays (m,) and (p,), all
        positive)."""
        su, sy = np.asarray(input_scale), np.asarray(output_scale)
        return Matrices(
            self.a, self.b * su, self.c / sy[:, None], self.d * su / sy[:, None], self.k * sy
        )

    def gain(self, z: complex) -> np.ndarray:
        """Transfer matrix C (zI - A)^-1 B + D at the complex number z, (p, m)."""
        return self.c @ np.linalg.solve(z * np.eye(self.order) - self.a, self.b) + self.d

    def poles(self) -> np.ndarray:
        """Eigenvalues of A, sorted by real part then imaginary part."""
        return np.sort_complex(np.linalg.eigvals(self.a))


def from_predictor(f: FloatArray, g: FloatArray, c: FloatArray, d: FloatArray) -> Matrices:
    """The inverse of (`predictor`, `predictor_input`): F (n, n), G (n, m + p), C (p, n), D (p,
    m)."""
    m = d.shape[1]
    k = g[:, m:]
    return Matrices(f + k @ c, g[:, :m] + k @ d, c, d, k)


def spectral_radius(a: FloatArray) -> float:
    """Largest absolute eigenvalue; 0 of an empty matrix."""
    return float(np.max(np.abs(np.linalg.eigvals(a)))) if a.size else 0.0


def steady_gain(
    a: FloatArray, c: FloatArray, q: FloatArray, r: FloatArray, s: FloatArray | None = None
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Steady-state Kalman gain of x+ = A x + w, y = C x + v with cov(w) = Q, cov(v) = R, cov(w, v)
    = S.

    Returns (K, Lambda, P): K = (A P C' + S) Lambda^-1, Lambda = C P C' + R, P the predicted state
    covariance from the discrete Riccati equation (Anderson and Moore 1979, section 4.4 and 5.4).
    Raises `ModelError` where the equation has no stabilising solution.
    """
    try:
        p = sla.solve_discrete_are(a.T, c.T, q, r, s=s)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise ModelError(
            f"no steady-state Kalman gain ({error})",
            fix="give process noise to every mode on or outside the unit circle",
        ) from None
    lam = c @ p @ c.T + r
    cross = a @ p @ c.T + (0.0 if s is None else s)
    return np.linalg.solve(lam.T, cross.T).T, lam, p


def balanced(system: Matrices, *, noise: FloatArray | None = None) -> tuple[Matrices, FloatArray]:
    """Balanced coordinates of the predictor ([u, y] -> y_hat) and its Hankel singular values (n,),
    largest first.

    The predictor is stable even where A is not, so that this always exists for a model that PEM
    returns (Moore 1981). `noise` (p, p) weighs the outputs by Lambda^-1/2. Raises `ModelError`
    where the predictor is not stable.
    """
    f, g = system.predictor, system.predictor_input
    if system.order == 0:
        return system, np.zeros(0)
    if spectral_radius(f) >= 1.0:
        raise ModelError(
            "cannot balance: the predictor A - KC is not stable",
            got=f"radius {spectral_radius(f):.4f}",
        )
    weight = np.eye(len(system.c)) if noise is None else np.linalg.inv(np.linalg.cholesky(noise))
    reach = _factor(sla.solve_discrete_lyapunov(f, g @ g.T))
    c = weight @ system.c
    observe = _factor(sla.solve_discrete_lyapunov(f.T, c.T @ c))
    left, values, right = np.linalg.svd(observe.T @ reach)
    values = np.maximum(values, 1e-14 * max(values[0], 1e-300))
    root = np.sqrt(values)
    forward = (left / root).T @ observe.T
    back = reach @ (right.T / root)
    return (
        Matrices(
            forward @ system.a @ back,
            forward @ system.b,
            system.c @ back,
            system.d,
            forward @ system.k,
        ),
        values,
    )


def truncated(system: Matrices, order: int) -> Matrices:
    """The first `order` balanced states of the predictor: a stable start for a smaller model."""
    b, _ = balanced(system)
    f, g = b.predictor, b.predictor_input
    return from_predictor(f[:order, :order], g[:order], b.c[:, :order], b.d)


def _factor(gramian: FloatArray) -> FloatArray:
    """L with L L' = gramian, also where the gramian is numerically singular."""
    values, vectors = np.linalg.eigh((gramian + gramian.T) / 2)
    floor = 1e-15 * max(float(values[-1]), 1e-300)
    return np.asarray(vectors * np.sqrt(np.maximum(values, floor)))
