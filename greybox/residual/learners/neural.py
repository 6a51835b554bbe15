"""A small neural network with a Bayesian last layer: its hidden units are the features.

The hidden layers (tanh) are trained on the smoothed discrepancy of the training flights, with weight decay, by L-BFGS with
gradients from CasADi; the last layer is then fitted by multi-step errors like any other. Several starts compete.
(Snoek et al. 2015, ICML: scalable Bayesian optimization using deep neural networks.)
"""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca
import numpy as np
import scipy.optimize

from greybox.residual.learners.learner import Features
from greybox.symbolic import Expr, FloatArray

FIRST, DECAY, STARTS, ROWS, ITERATIONS = 16, 1e-3, 2, 1500, 300
"""Units of the first hidden layer, weight decay, starts, most rows that are trained on, and iterations of L-BFGS."""


class NeuralLastLayer:
    """Two hidden layers; the units of the second, and the inputs, are the features."""

    name = "neural"

    def features(self, x: FloatArray, y: FloatArray, *, points: int, seed: int) -> Mapping[str, Features]:
        """One candidate per start."""
        rows = np.random.default_rng(seed).permutation(len(x))[:ROWS]
        units = min(points, 24)
        return {
            f"network, start {k + 1}": _trained(x[rows], y[rows], units=units, seed=seed + k) for k in range(STARTS)
        }


def _layers(v: Expr, n_in: int, units: int, n_out: int) -> list[Expr]:
    """Weights W1, b1, W2, b2, W3 out of one vector."""
    out, at = [], 0
    for rows, columns in ((FIRST, n_in), (FIRST, 1), (units, FIRST), (units, 1), (n_out, units)):
        out.append(ca.reshape(v[at : at + rows * columns], rows, columns))
        at += rows * columns
    return out


def _hidden(s: Expr, layers: list[Expr], count: int) -> Expr:
    first = ca.tanh(layers[0] @ s + ca.repmat(layers[1], 1, count))
    return ca.tanh(layers[2] @ first + ca.repmat(layers[3], 1, count))


def _trained(x: FloatArray, y: FloatArray, *, units: int, seed: int) -> Features:
    n, n_in, n_out = len(x), x.shape[1], y.shape[1]
    size = FIRST * n_in + FIRST + units * FIRST + units + n_out * units
    v = ca.MX.sym("v", size)
    layers = _layers(v, n_in, units, n_out)
    error = layers[4] @ _hidden(ca.DM(x.T), layers, n) - ca.DM(y.T)
    cost = ca.sumsqr(error) / n + DECAY * ca.sumsqr(v)
    both = ca.Function("cost", [v], [cost, ca.gradient(cost, v)])
    start = np.random.default_rng(seed).standard_normal(size)
    start[: FIRST * n_in] /= np.sqrt(n_in)
    start[FIRST * n_in :] *= 0.5 / np.sqrt(FIRST)

    def value(w: FloatArray) -> tuple[float, FloatArray]:
        c, g = both(w)
        return float(c), np.asarray(g).ravel()

    best = scipy.optimize.minimize(value, start, jac=True, method="L-BFGS-B", options={"maxiter": ITERATIONS})
    found = _layers(ca.DM(best.x), n_in, units, n_out)

    def phi(s: Expr) -> Expr:
        return ca.vertcat(_hidden(s, found, 1) / np.sqrt(units), s / np.sqrt(n_in))

    return phi
