"""A small neural network with a Bayesian last layer: its hidden units are the features.

The hidden layers (tanh) are trained on the smoothed discrepancy of the training flights, with
weight decay, by L-BFGS; the last layer is then fitted by multi-step errors like any other. Several
starts compete. (Snoek et al. 2015, ICML: scalable Bayesian optimization using deep neural
networks.)
"""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca
import numpy as np
import scipy.optimize

from greybox.residual.learners.learner import Features
from greybox.symbolic import Expr, FloatArray

FIRST, DECAY, STARTS, ROWS, ITERATIONS = 16, 1e-3, 2, 1500, 300
"""Units of the first hidden layer, weight decay, starts, most rows that are trained on, and
iterations of L-BFGS."""


class NeuralLastLayer:
    """Two hidden layers; the units of the second, and the inputs, are the features."""

    name = "neural"

    def features(
        self, x: FloatArray, y: FloatArray, *, points: int, seed: int
    ) -> Mapping[str, Features]:
        """One candidate per start."""
        rows = np.random.default_rng(seed).permutation(len(x))[:ROWS]
        units = min(points, 24)
        return {
            f"network, start {k + 1}": trained(x[rows], y[rows], units=units, seed=seed + k)
            for k in range(STARTS)
        }


def _layers(v: FloatArray, n_in: int, units: int, n_out: int) -> list[FloatArray]:
    """Views W1, b1, W2, b2, W3 of one vector."""
    out, at = [], 0
    for rows, columns in ((FIRST, n_in), (FIRST, 1), (units, FIRST), (units, 1), (n_out, units)):
        out.append(v[at : at + rows * columns].reshape(rows, columns))
        at += rows * columns
    return out


def trained(x: FloatArray, y: FloatArray, *, units: int, seed: int) -> Features:
    """The `units` of the last hidden layer and the inputs, of a network trained on rows x (N,
    n_in), y (N, n_out)."""
    n, n_in, n_out = len(x), x.shape[1], y.shape[1]
    size = FIRST * n_in + FIRST + units * FIRST + units + n_out * units
    start = np.random.default_rng(seed).standard_normal(size)
    start[: FIRST * n_in] /= np.sqrt(n_in)
    start[FIRST * n_in :] *= 0.5 / np.sqrt(FIRST)

    def value(v: FloatArray) -> tuple[float, FloatArray]:
        """Mean squared error with decay, and its gradient by back-propagation."""
        w1, b1, w2, b2, w3 = _layers(v, n_in, units, n_out)
        first = np.tanh(w1 @ x.T + b1)
        second = np.tanh(w2 @ first + b2)
        error = w3 @ second - y.T
        slope = np.zeros_like(v)
        g1, g_b1, g2, g_b2, g3 = _layers(slope, n_in, units, n_out)
        g3[:] = error @ second.T
        back = (w3.T @ error) * (1 - second**2)
        g2[:], g_b2[:] = back @ first.T, back.sum(axis=1, keepdims=True)
        back = (w2.T @ back) * (1 - first**2)
        g1[:], g_b1[:] = back @ x, back.sum(axis=1, keepdims=True)
        return float(np.sum(error**2) / n + DECAY * v @ v), 2 * slope / n + 2 * DECAY * v

    best = scipy.optimize.minimize(
        value, start, jac=True, method="L-BFGS-B", options={"maxiter": ITERATIONS}
    )
    w1, b1, w2, b2, _ = (ca.DM(m) for m in _layers(best.x, n_in, units, n_out))

    def phi(s: Expr) -> Expr:
        hidden = ca.tanh(w2 @ ca.tanh(w1 @ s + b1) + b2)
        return ca.vertcat(hidden / np.sqrt(units), s / np.sqrt(n_in))

    return phi
