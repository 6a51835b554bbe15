"""Hover and the linear feedback about it: what the tube falls back on, and what an export flies
with on board.

The gain is that of a linear-quadratic regulator in the model's error coordinates (Rawlings, Mayne
and Diehl, Model Predictive Control, 2017, section 1.3). What is steered is told by what depends on
what: states that no command reaches (disturbances, noise of sensors) and states that the motion
does not feel (filters, delays of readings) are no part of a plan.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import casadi as ca
import numpy as np
import scipy.linalg

from greybox.errors import ModelError
from greybox.symbolic import BoolArray, FloatArray, Layout
from mpc_export.semidefinite import positive

NEEDED = ("position", "velocity", "attitude", "rate")
"""Blocks of the state that a model must have to be flown."""
NEAR = {"position": 0.3, "velocity": 1.0}
"""The feedback corrects no more than this at a time [m, m/s]: its gain is linear and the commands
are bounded."""


@dataclass(frozen=True, kw_only=True)
class Weights:
    """Weights of the tracking cost, 0.5 (weight x error)^2 per stage.

    position [1/m], velocity [s/m], yaw [1/rad], rate [s/rad], command (distance from the steady
    command) and change of the command per sample, both per unit of command.
    """

    position: float = 8.0
    velocity: float = 1.5
    yaw: float = 2.0
    rate: float = 0.3
    command: float = 0.6
    change: float = 3.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (math.isfinite(value) and value >= 0):
                raise ModelError(f"weight {name} must be finite and not negative", got=f"{value:g}")


def rows(layout: Layout, name: str) -> list[int]:
    """Rows of a block of states, such as "position"."""
    return [i for i, n in enumerate(layout.names) if n.startswith(f"{name}.")]


def demand_flight(states: Layout, name: str) -> None:
    """Raises `ModelError` for a model that has no position, velocity, attitude and rates."""
    missing = [n for n in NEEDED if not rows(states, n)]
    if missing:
        raise ModelError(
            f"the controller needs a model with {', '.join(missing)}",
            got=name,
            fix="fit on flights with pose or position and attitude",
        )


def hover(
    functions: Mapping[str, ca.Function],
    states: Layout,
    start: tuple[FloatArray, FloatArray],
    p: FloatArray,
    targets: int,
) -> tuple[FloatArray, FloatArray]:
    """(x, u) at level hover at the origin without disturbances, by `target_step` from `start`.
    Raises `ModelError`."""
    x, u = (np.array(v, dtype=float) for v in start)
    for i, n in enumerate(states.names):
        if n.startswith(("disturbance.", "position.", "velocity.", "rate.", "attitude.")):
            x[i] = float(n == "attitude.w")
    goal = np.zeros(targets)
    for _ in range(30):
        x, u, residual = (v.full().ravel() for v in functions["target_step"](x, u, p, goal))
        if residual[0] < 1e-10:
            break
    else:
        raise ModelError(
            "the model has no steady hover", got=f"condition missed by {residual[0]:.2g}"
        )
    return x, u


def cost(errors: Layout, commands: int, w: Weights) -> tuple[FloatArray, FloatArray]:
    """Stage cost about hover as Q (n_d, n_d) and R (n_u, n_u)."""
    q = np.full(len(errors), 1e-6)
    for name, weight in (("position", w.position), ("velocity", w.velocity), ("rate", w.rate)):
        q[rows(errors, f"d_{name}")] += weight**2
    q[rows(errors, "d_attitude")[2]] += w.yaw**2
    r = np.full(commands, w.command**2 + w.change**2 + 1e-9)
    return np.diag(q), np.diag(r)


class Steered(NamedTuple):
    """Places of error states: `keep` of those that commands move and the motion feels, `pushing` of
    those that push the motion and that no command moves. All others do not bear on a plan."""

    keep: tuple[int, ...]
    pushing: tuple[int, ...]


def dependences(functions: Mapping[str, ca.Function]) -> tuple[ca.Sparsity, ca.Sparsity]:
    """Which error states of the next sample depend on which of this one (n_d, n_d), and on which
    command (n_d, n_u), whatever the numbers are."""
    step = functions["f_d"]
    x, u, p = (ca.MX.sym(n, step.size1_in(i)) for i, n in enumerate("xup"))
    d = ca.MX.sym("d", functions["boxplus"].size1_in(1))
    after = functions["boxminus"](step(functions["boxplus"](x, d), u, p), x)
    made = ca.Function("after", [x, u, p, d], [after])
    return made.jac_sparsity(0, 3), made.jac_sparsity(0, 1)


def steered(functions: Mapping[str, ca.Function], errors: Layout) -> Steered:
    """What of the error states a plan steers, and what pushes it."""
    a, b = (np.asarray(ca.DM(s, 1.0).full() != 0) for s in dependences(functions))
    own: BoolArray = np.zeros(len(errors), dtype=bool)
    own[[i for n in NEEDED for i in rows(errors, f"d_{n}")]] = True
    moved, felt = _reached(a, np.asarray(b.any(axis=1))), _reached(a.T, own)
    return Steered(
        keep=tuple(np.flatnonzero(moved & felt).tolist()),
        pushing=tuple(np.flatnonzero(felt & ~moved).tolist()),
    )


def _reached(by: BoolArray, start: BoolArray) -> BoolArray:
    """States (n,) that some of `start` reach in any number of samples; by[i, j]: j reaches i."""
    found = start
    for _ in start:
        found = found | by[:, found].any(axis=1)
    return found


def lqr(
    a: FloatArray, b: FloatArray, q: FloatArray, r: FloatArray, split: Steered
) -> tuple[FloatArray, FloatArray]:
    """(K, P): u = K d over all error states, and the cost P (n_k, n_k) of what the plan may change,
    positive semidefinite by construction. Raises `ModelError` where no feedback steers the model.

    Disturbances cannot be steered; with the cost d'P d + 2 d'X e, e the disturbances that go on as
    Phi e,

        K_d = -S^-1 B'P A_dd,   K_e = -S^-1 B'(P A_de + X Phi),   S = R + B'P B,
        X = (A_dd + B K_d)'(P A_de + X Phi).
    """
    kept, rest = np.array(split.keep, dtype=int), np.array(split.pushing, dtype=int)
    a_dd, a_de, phi, b_d = (
        a[np.ix_(kept, kept)],
        a[np.ix_(kept, rest)],
        a[np.ix_(rest, rest)],
        b[kept],
    )
    own, p = _regulator(a_dd, b_d, q[np.ix_(kept, kept)], r)
    s, closed = r + b_d.T @ p @ b_d, a_dd + b_d @ own
    gain = np.zeros((b.shape[1], a.shape[0]))
    gain[:, kept] = own
    x = np.linalg.solve(
        np.eye(len(kept) * len(rest)) - np.kron(phi.T, closed.T),
        (closed.T @ p @ a_de).ravel(order="F"),
    ).reshape(len(kept), len(rest), order="F")
    gain[:, rest] = -np.linalg.solve(s, b_d.T @ (p @ a_de + x @ phi))
    return gain, p


def _regulator(
    a: FloatArray, b: FloatArray, q: FloatArray, r: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """(K, P) of the discrete Riccati equation. P is what the feedback K costs, the sum of
    F'^i (Q + K'R K) F^i with F = A + B K, doubled from 2^j to 2^(j + 1) terms: a sum of squares,
    which no error of the Riccati solver makes negative."""
    try:
        p = scipy.linalg.solve_discrete_are(a, b, q, r)
        gain = -np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)
    except (np.linalg.LinAlgError, ValueError):
        gain = np.full(b.T.shape, np.nan)
    closed = a + b @ gain
    if not (np.isfinite(closed).all() and np.abs(np.linalg.eigvals(closed)).max() < 1.0):
        raise ModelError(
            "no feedback about hover steers this model",
            expected="a state that its commands bring back to hover",
            fix="fit on flights in which every command moves the craft",
        )
    cost, power = positive(q + gain.T @ r @ gain), closed
    while np.abs(power).max() > np.finfo(float).eps:
        cost, power = positive(cost + power.T @ cost @ power), power @ power
    return gain, cost
