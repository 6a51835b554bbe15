"""Random linear systems with known matrices and noise, simulated in open or closed loop. NumPy
only.

x[k+1] = A x[k] + B u[k] + K e[k],  y[k] = C x[k] + e[k],  cov(e) = Lambda. K and Lambda come from the Riccati equation of
a plant with process and measurement noise, so that the disturbance is coloured and the predictor A - KC is stable.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


class LinearTruth(NamedTuple):
    """A (n, n), B (n, m), C (p, n), K (n, p), Lambda (p, p); D = 0."""

    a: Array
    b: Array
    c: Array
    k: Array
    noise: Array


def riccati(a: Array, c: Array, q: Array, r: Array) -> Array:
    """Stationary predicted covariance of a Kalman filter, by iterating the filter to rest (A
    stable)."""
    p = q.copy()
    for _ in range(10000):
        gain = a @ p @ c.T @ np.linalg.inv(c @ p @ c.T + r)
        new = a @ p @ a.T + q - gain @ c @ p @ a.T
        new = (new + new.T) / 2
        if np.abs(new - p).max() < 1e-14 * np.abs(new).max():
            return new
        p = new
    return p


def lyapunov(a: Array, q: Array) -> Array:
    """X = A X A' + Q by its linear equations."""
    n = len(a)
    return np.asarray(
        np.linalg.solve(np.eye(n * n) - np.kron(a, a), q.ravel()).reshape(n, n), dtype=np.float64
    )


def random_system(
    rng: np.random.Generator, n: int, m: int, p: int, *, snr: float = 10.0, coloured: bool = True
) -> LinearTruth:
    """Poles between 0.3 and 0.95 in size at angles well apart; `snr` is the rms ratio of driven
    output to disturbance.

    The ratio holds for unit white inputs, as the geometric mean over the outputs (10 is 20 dB).
    """
    a = np.zeros((n, n))
    angles = rng.permutation(np.linspace(0.25, 2.6, max(n, 2)))
    i = 0
    while i < n:
        if i + 1 < n and (rng.random() < 0.7 or n > 4):
            radius, w = rng.uniform(0.5, 0.95), angles[i]
            a[i : i + 2, i : i + 2] = radius * np.array(
                [[np.cos(w), np.sin(w)], [-np.sin(w), np.cos(w)]]
            )
            i += 2
        else:
            a[i, i] = rng.choice([-1, 1]) * rng.uniform(0.3, 0.95)
            i += 1
    b, c = rng.normal(size=(n, m)), rng.normal(size=(p, n))
    k, noise = np.zeros((n, p)), np.eye(p)
    if coloured:
        q, r = np.diag(rng.uniform(0.1, 1.0, n)), np.diag(rng.uniform(0.5, 1.5, p)) * n
        cov = riccati(a, c, q, r)
        noise = c @ cov @ c.T + r
        k = a @ cov @ c.T @ np.linalg.inv(noise)
    driven = np.diag(c @ lyapunov(a, b @ b.T) @ c.T)
    disturbed = np.diag(c @ lyapunov(a, k @ noise @ k.T) @ c.T + noise)
    factor = float(np.exp(np.mean(np.log(driven / disturbed))) / snr**2)
    return LinearTruth(a, b, c, k, noise * factor)


def simulate(
    rng: np.random.Generator,
    truth: LinearTruth,
    count: int,
    *,
    feedback: Array | None = None,
    excitation: float = 1.0,
) -> tuple[Array, Array]:
    """(u (N, m), y (N, p)) from x = 0. White excitation r; with `feedback` (m, p) u[k] = r[k] -
    feedback y[k]."""
    a, b, c, k, noise = truth
    e = rng.normal(size=(count, len(c))) @ np.linalg.cholesky(noise).T
    r = excitation * rng.normal(size=(count, b.shape[1]))
    x, u, y = np.zeros(len(a)), np.zeros((count, b.shape[1])), np.zeros((count, len(c)))
    for i in range(count):
        y[i] = c @ x + e[i]
        u[i] = r[i] if feedback is None else r[i] - feedback @ y[i]
        x = a @ x + b @ u[i] + k @ e[i]
    return u, y


def stabilising_feedback(
    rng: np.random.Generator, truth: LinearTruth, *, strength: float = 0.5, tries: int = 200
) -> Array:
    """A random static output feedback (m, p) with closed-loop poles inside 0.97, as strong as that
    allows."""
    m, p = truth.b.shape[1], truth.c.shape[0]
    scale = strength / max(float(np.linalg.norm(truth.c @ truth.b, 2)), 1e-12)
    for _ in range(tries):
        gain = scale * rng.normal(size=(m, p))
        if np.abs(np.linalg.eigvals(truth.a - truth.b @ gain @ truth.c)).max() < 0.97:
            return np.asarray(gain)
        scale *= 0.95
    return np.zeros((m, p))
