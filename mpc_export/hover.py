"""Hover: one small optimal control problem that every consumer can pose, and its solution by IPOPT
to compare with.

From a displaced state to the reference in N samples: least squares of the error state (boxminus, so
that an attitude error is an angle and not a difference of quaternions) and of the command, with the
bounds of the commands,

    min  sum_k dt/2 |W r(x_k, u_k)|^2 + final/2 |W_x boxminus(x_N, x_ref)|^2,   r = (boxminus(x, x_ref), u - u_ref).

Disturbances and the command history are not steered: their weights are zero.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from mpc_export.exported import Exported, Expr

Array = npt.NDArray[np.float64]
ATTITUDE = 0.3
"""Typical attitude error [rad]."""
FREE = ("history.", "disturbance.", "coloured.", "drift.", "line.", "low_pass.", "delay.")
"""Prefixes of states that no cost looks at: past commands and noise."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Hover:
    """The problem in numbers: `start` (n_x,), squared weights of the error state (n_d,) and of the
    command (n_u,)."""

    steps: int
    start: Array
    state_weights: Array
    input_weights: Array
    final: float


def hover(model: Exported, steps: int = 20) -> Hover:
    """The problem of a model: displaced by a third of the typical size of each of its own
    states."""
    typical = dict(zip(model.states, model.state_scale.tolist()))
    own = [n.removeprefix("d_") for n in model.error_states]
    size = np.array([typical.get(n, ATTITUDE) for n in own])
    free = np.array([n.startswith(FREE) for n in own])
    still = free | np.array([n.startswith("rotor") for n in own])
    moved = np.where(still, 0.0, 0.3 * size * np.resize([1.0, -1.0, 0.5], size.size))
    return Hover(
        steps=steps,
        start=model["boxplus"](model.reference_state, moved).full().ravel(),
        state_weights=np.where(free, 0.0, 1.0 / size**2),
        input_weights=1.0 / model.input_scale**2,
        final=1.0,
    )


def residual(model: Exported, x: Expr, u: Expr | None = None) -> Expr:
    """r(x, u), or its state part for the last sample."""
    state = model["boxminus"](x, model.reference_state)
    return state if u is None else ca.vertcat(state, u - model.reference_inputs)


def stage_cost(model: Exported, problem: Hover, x: Expr, u: Expr) -> Expr:
    """Cost of one sample."""
    weights = np.concatenate([problem.state_weights, problem.input_weights])
    return 0.5 * model.dt * ca.dot(weights, residual(model, x, u) ** 2)


def final_cost(model: Exported, problem: Hover, x: Expr) -> Expr:
    """Cost of the last state."""
    return 0.5 * problem.final * ca.dot(problem.state_weights, residual(model, x) ** 2)


def solve(model: Exported, problem: Hover) -> tuple[Array, Array]:
    """(X (N+1, n_x), U (N, n_u)) by multiple shooting and IPOPT. Raises `RuntimeError` when it does
    not converge."""
    nx, nu, n = len(model.states), len(model.inputs), problem.steps
    states = [ca.MX.sym(f"x{k}", nx) for k in range(n + 1)]
    inputs = [ca.MX.sym(f"u{k}", nu) for k in range(n)]
    cost = final_cost(model, problem, states[n])
    gaps = []
    for k in range(n):
        cost += stage_cost(model, problem, states[k], inputs[k])
        gaps.append(states[k + 1] - model["f_d"](states[k], inputs[k], model.parameter_values))
    options: dict[str, Expr] = {
        "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-10, "bound_relax_factor": 0.0},
        "print_time": False,
    }
    problem_ = {"x": ca.vertcat(*states, *inputs), "f": cost, "g": ca.vertcat(*gaps)}
    solver = ca.nlpsol("hover", "ipopt", problem_, options)
    free = np.full(n * nx, np.inf)
    found = (
        solver(
            x0=np.concatenate([np.tile(problem.start, n + 1), np.tile(model.reference_inputs, n)]),
            lbx=np.concatenate([problem.start, -free, np.tile(model.lower, n)]),
            ubx=np.concatenate([problem.start, free, np.tile(model.upper, n)]),
            lbg=0.0,
            ubg=0.0,
        )["x"]
        .full()
        .ravel()
    )
    if not solver.stats()["success"]:
        raise RuntimeError(f"IPOPT: {solver.stats()['return_status']}")
    return found[: (n + 1) * nx].reshape(n + 1, nx), found[(n + 1) * nx :].reshape(n, nu)
