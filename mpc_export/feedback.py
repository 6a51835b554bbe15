"""Hover and the linear feedback about it: what the tube falls back on, and what an export flies
with on board.

The gain is that of a linear-quadratic regulator in the model's error coordinates (Rawlings, Mayne
and Diehl, Model Predictive Control, 2017, section 1.3); disturbances are states that no command
moves.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
import scipy.linalg

from greybox.errors import ModelError
from greybox.symbolic import FloatArray, Layout

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


def lqr(
    a: FloatArray, b: FloatArray, q: FloatArray, r: FloatArray, keep: Sequence[int]
) -> tuple[FloatArray, FloatArray]:
    """(K, P): u = K d over all error states, and the cost P (n_k, n_k) of what the plan may change.

    Disturbances cannot be steered; with the cost d'P d + 2 d'X e, e the disturbances that go on as
    Phi e,

        K_d = -S^-1 B'P A_dd,   K_e = -S^-1 B'(P A_de + X Phi),   S = R + B'P B,
        X = (A_dd + B K_d)'(P A_de + X Phi).
    """
    kept = np.array(keep)
    rest = np.setdiff1d(np.arange(a.shape[0]), kept)
    a_dd, a_de, phi, b_d = (
        a[np.ix_(kept, kept)],
        a[np.ix_(kept, rest)],
        a[np.ix_(rest, rest)],
        b[kept],
    )
    p = scipy.linalg.solve_discrete_are(a_dd, b_d, q[np.ix_(kept, kept)], r)
    s = r + b_d.T @ p @ b_d
    gain = np.zeros((b.shape[1], a.shape[0]))
    gain[:, kept] = -np.linalg.solve(s, b_d.T @ p @ a_dd)
    closed = a_dd + b_d @ gain[:, kept]
    x = np.linalg.solve(
        np.eye(len(kept) * len(rest)) - np.kron(phi.T, closed.T),
        (closed.T @ p @ a_de).ravel(order="F"),
    ).reshape(len(kept), len(rest), order="F")
    gain[:, rest] = -np.linalg.solve(s, b_d.T @ (p @ a_de + x @ phi))
    return gain, np.asarray(p)
