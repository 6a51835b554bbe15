"""Stage functions of the controller as CasADi functions: dynamics, cost, limits, tube.

Error coordinates are those of the exported model (x = x_plan boxplus d). The tracking residual of a
stage is

    r = (w_p (position - reference), w_v (velocity - reference), w_psi sin(psi - reference)
    cos(theta),
         w_omega omega, w_u (u - u_steady), w_du (u - u_before)),      cost = 0.5 r'r,      Hessian = J'J (Gauss-Newton),

and the last stage costs 0.5 e'P e, e the error state against the reference state, P the solution of
the discrete Riccati equation at hover, which bounds the cost of the linear feedback from there on
(Rawlings, Mayne and Diehl, Model Predictive Control, 2017, section 2.5.2). The tube: with the
estimate x_hat = x - e_hat, e_hat of covariance P_f (the filter's, stationary), and u = u_plan + K
(x_hat - x_plan),

    total = P_f + Z + c c' + b Cov(theta) b' + D_k,
    Z+ = (A + B K) Z (A + B K)' + W,    W = sum A_1^i (L S L' + U) A_1^i',     Z = 0 where the plan starts at the estimate,
    c+ = (A + B K) c + B_d sd_g,        b+ = (A + B K) b + df_d/dtheta.

W is what the filter's innovations (covariance S, gain L, transition A_1) move the estimate by in
the samples of one stage (separation of estimation and control; Anderson and Moore 1979, chapter 5),
U the noise that the model states ahead beyond its filter's: at one sample time for all W is at least
A P_f A' + Q - P_f. D_k is what this linear loop leaves out (second_order.py). Errors of the learned
function (standard deviation sd_g) and of the parameters theta stay the same over a horizon and are
consider states (Schmidt 1966), not noise that is fresh
at every step. In the worst case the sums are outer ellipsoids with the least trace: E(X) + E(Y)
inside E((1 + 1/a) X + (1 + a) Y), a = sqrt(tr X / tr Y) (Kurzhanski and Valyi 1997, section 2.7).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from greybox.errors import ModelError
from greybox.frames import GRAVITY, rotation_matrix
from greybox.symbolic import Expr, FloatArray
from mpc_export.feedback import (
    Weights,
    cost,
    demand_flight,
    dependences,
    hover,
    lqr,
    rows,
    steered,
)
from mpc_export.functions import ModelFunctions
from mpc_export.semidefinite import positive, upper_half
from mpc_export.tube.problem import TubeProblem
from mpc_export.tube.second_order import second_order


@dataclass(frozen=True, kw_only=True, eq=False)
class Stages:
    """The functions by name, and what was computed once.

    keep: error states (n_k) that the plan may change (`feedback.steered`); free: raw states of
    the disturbances; gain K (n_u, n_d); terminal P (n_k, n_k); steady = (x, u) at hover; estimate
    P_f and fresh W (n_d, n_d); bent D (N + 1, n_d, n_d), which `tube_spread` does not hold;
    covariance of the parameters (n_theta, n_theta); white: see `stages`; worst_case: kind of the
    tube; places: first rows of position and velocity in x; back: a stage [s] and how hard the limit of
    tilt brakes [m/s^2].

    `tube_spread` says the recursion in symbols; controller.c computes it from `tube_linear` and
    `tube_unsure`, with A's zeros left out.
    """

    functions: Mapping[str, ca.Function]
    keep: tuple[int, ...]
    free: tuple[int, ...]
    gain: FloatArray
    terminal: FloatArray
    steady: tuple[FloatArray, FloatArray]
    estimate: FloatArray
    fresh: FloatArray
    bent: FloatArray
    covariance: FloatArray
    white: bool
    worst_case: bool
    places: tuple[int, int]
    back: tuple[float, float]


def stages(
    model: ModelFunctions,
    problem: TubeProblem,
    *,
    white: bool = False,
    estimate: FloatArray | None = None,
    fresh: FloatArray | None = None,
) -> Stages:
    """Stage functions for a model exported at the controller's sample time with groups "covariance"
    and "target".

    white: treat the learned function's error as noise that is fresh at every step, for comparison.
    estimate and fresh (n_d, n_d): P_f and W of the filter that will run; default those of a filter
    at the model's sample time, of which P_f is too wide, and W too narrow, where the real one runs
    faster than the plan. Raises `ModelError` for a model that has no position, velocity, attitude
    and rates.
    """
    _check(model, problem)
    x_steady, u_steady = hover(
        model.functions, model.states, model.reference, model.parameter_values, len(model.targets)
    )
    split = steered(model.functions, model.error_states)
    keep = split.keep
    free = tuple(block(model, "disturbance"))
    _, a, b, _ = (v.full() for v in model["f_d_jac"](x_steady, u_steady, model.parameter_values))
    gain, terminal = lqr(a, b, *_weights(model, problem.weights), split)
    if problem.ancillary is not None:
        gain, _ = lqr(a, b, *_weights(model, problem.ancillary), split)
    if not problem.feedback:
        gain = np.zeros_like(gain)
    estimate = model.noise.covariance if estimate is None else np.asarray(estimate, dtype=float)
    fresh = positive(
        a @ estimate @ a.T + model.noise.process - estimate if fresh is None else np.asarray(fresh)
    )
    made = [
        _step(model),
        _linear(model, keep),
        *_charts(model, keep),
        _cost(model, problem, keep),
        _end(model, keep, terminal),
        _limits(model, problem, keep),
        _unsure(model),
        _spread(model, problem, gain, estimate, fresh, white),
    ]
    return Stages(
        functions={f.name(): f for f in made},
        keep=keep,
        free=free,
        gain=gain,
        terminal=terminal,
        steady=(x_steady, u_steady),
        estimate=estimate,
        fresh=fresh,
        bent=second_order(model, problem, gain, fresh, (x_steady, u_steady)),
        covariance=np.asarray(model.covariance, dtype=float),
        white=white,
        worst_case=problem.kind == "worst case",
        places=(block(model, "position")[0], block(model, "velocity")[0]),
        back=(problem.dt, GRAVITY * math.tan(min(problem.tilt_max, 1.5))),
    )


def _check(model: ModelFunctions, problem: TubeProblem) -> None:
    demand_flight(model.states, model.name)
    if abs(model.dt - problem.dt) > 1e-9:
        raise ModelError(
            "model and controller differ in sample time",
            expected=f"{problem.dt:g}",
            got=f"{model.dt:g} s",
        )
    for name in ("consider_step", "target_step"):
        if name not in model.functions:
            raise ModelError(
                f"the model was exported without {name}",
                fix='model_functions(..., with_=("covariance", "target"))',
            )


def block(model: ModelFunctions, name: str, *, error: bool = False) -> list[int]:
    """Rows of a block of the state, such as "position", or of the error state."""
    return rows(model.error_states, f"d_{name}") if error else rows(model.states, name)


def _weights(model: ModelFunctions, w: Weights) -> tuple[FloatArray, FloatArray]:
    """Stage cost about hover as Q (n_d, n_d) and R (n_u, n_u)."""
    return cost(model.error_states, len(model.inputs), w)


def _arguments(model: ModelFunctions) -> tuple[Expr, Expr, Expr]:
    n = model.sizes
    return ca.MX.sym("x", n["n_x"]), ca.MX.sym("u", n["n_u"]), ca.MX.sym("p", n["n_p"])


def _step(model: ModelFunctions) -> ca.Function:
    """(x, u, p) -> next state."""
    arguments = _arguments(model)
    return ca.Function("tube_step", [*arguments], [model["f_d"](*arguments)])


def _linear(model: ModelFunctions, keep: tuple[int, ...]) -> ca.Function:
    """(x, u, p) -> next state; A (its nonzeros), B of what the plan may change; A (its nonzeros), B
    of all."""
    x, u, p = _arguments(model)
    after, a, b, _ = model["f_d_jac"](x, u, p)
    rows, pattern = list(keep), dependences(model.functions)[0]
    plan = pattern.sub(rows, rows)[0]
    return ca.Function(
        "tube_linear",
        [x, u, p],
        [after, _picked(a[rows, rows], plan), ca.densify(b[rows, :]), _picked(a, pattern), b],
    )


def _picked(m: Expr, pattern: ca.Sparsity) -> Expr:
    """m (dense) with the nonzeros of the pattern alone: by their places, which is quicker in C than
    a projection."""
    rows, columns = pattern.get_triplet()
    return ca.MX(pattern, m.nz[[r + m.shape[0] * c for r, c in zip(rows, columns, strict=True)]])


def _unsure(model: ModelFunctions) -> ca.Function:
    """(x, u, p) -> what one standard deviation of the learned functions moves the next state by
    (n_d, n_g), and its slope in the uncertain parameters (n_d, n_theta)."""
    n = model.sizes
    x, u, p = _arguments(model)
    known = {"x": x, "u": u, "p": p}
    zeros = {"K": (n["n_u"], n["n_d"]), "S": (n["n_d"],) * 2}
    known |= {k: ca.DM(*v) for k, v in zeros.items()}
    step = model["consider_step"].call(
        known
        | ({"c": ca.DM(n["n_d"], n["n_g"])} if n["n_g"] else {})
        | ({"b": ca.DM(n["n_d"], n["n_theta"])} if n["n_theta"] else {}),
        True,  # inlined, so that what is multiplied by nothing is not computed
        False,
    )
    push = step.get("c_next", ca.DM(n["n_d"], 0))
    slope = step.get("b_next", ca.DM(n["n_d"], 0))
    return ca.Function("tube_unsure", [x, u, p], [ca.densify(v) for v in (push, slope)])


def _charts(model: ModelFunctions, keep: tuple[int, ...]) -> tuple[ca.Function, ca.Function]:
    n = model.sizes
    x, y, d = ca.MX.sym("x", n["n_x"]), ca.MX.sym("y", n["n_x"]), ca.MX.sym("d", len(keep))
    spread = ca.DM(n["n_d"], len(keep))
    for j, i in enumerate(keep):
        spread[i, j] = 1.0
    gap = model["boxminus"](x, y)[list(keep)]
    moved = model["boxplus"](x, ca.densify(spread @ d))
    return ca.Function("tube_gap", [x, y], [ca.densify(gap)]), ca.Function(
        "tube_move", [x, d], [moved]
    )


def _moved(model: ModelFunctions, keep: tuple[int, ...]) -> tuple[Expr, Expr, Expr]:
    """(x, d, x boxplus d) as SX, d (n_k)."""
    x, d = ca.SX.sym("x", len(model.states)), ca.SX.sym("d", len(keep))
    full = ca.SX.zeros(len(model.error_states))
    for j, i in enumerate(keep):
        full[i] = d[j]
    return x, d, model.sampled.boxplus(x, full)


def _cost(model: ModelFunctions, problem: TubeProblem, keep: tuple[int, ...]) -> ca.Function:
    """(x, u, u_before, ref) -> cost and its derivatives in (d, u_before, u); ref = position,
    velocity, psi, u_steady."""
    w = problem.weights
    x, d, moved = _moved(model, keep)
    nu = len(model.inputs)
    u, before, ref = ca.SX.sym("u", nu), ca.SX.sym("v", nu), ca.SX.sym("ref", 7 + nu)
    turn = rotation_matrix(moved[block(model, "attitude")])
    heading = ca.cos(ref[6]) * turn[1, 0] - ca.sin(ref[6]) * turn[0, 0]
    residual = ca.vertcat(
        w.position * (moved[block(model, "position")] - ref[:3]),
        w.velocity * (moved[block(model, "velocity")] - ref[3:6]),
        w.yaw * heading,
        w.rate * moved[block(model, "rate")],
        w.command * (u - ref[7:]),
        w.change * (u - before),
    )
    return _squares("tube_cost", [x, u, before, ref], residual, (d, before, u), d, sparse=True)


def _squares(
    name: str,
    arguments: list[Expr],
    residual: Expr,
    by: tuple[Expr, ...],
    at_zero: Expr,
    *,
    sparse: bool = False,
) -> ca.Function:
    """Value, gradient and Gauss-Newton Hessian of 0.5 r'r in `by`, at `at_zero` = 0; sparse: of the
    Hessian there are the nonzeros."""
    jacobian = ca.horzcat(*(ca.jacobian(residual, v) for v in by))
    value, slope = ca.substitute([residual, jacobian], [at_zero], [ca.DM.zeros(at_zero.shape)])
    found = ca.cse([0.5 * ca.sumsqr(value), slope.T @ value, slope.T @ slope])
    found[2] = ca.sparsify(found[2]) if sparse else ca.densify(found[2])
    return ca.Function(name, arguments, [*map(ca.densify, found[:2]), found[2]])


def _end(model: ModelFunctions, keep: tuple[int, ...], terminal: FloatArray) -> ca.Function:
    """(x, x_end) -> terminal cost and its derivatives in d."""
    x, d, moved = _moved(model, keep)
    goal = ca.SX.sym("goal", len(model.states))
    error = model.sampled.boxminus(moved, goal)[list(keep)]
    return _squares("tube_end", [x, goal], ca.DM(upper_half(terminal)) @ error, (d,), d)


def _limits(model: ModelFunctions, problem: TubeProblem, keep: tuple[int, ...]) -> ca.Function:
    """(x, planes (4, n)) -> values that must not be positive, and their Jacobian in d: planes, then
    tilt."""
    x, d, moved = _moved(model, keep)
    planes = ca.SX.sym("planes", 4, problem.planes)
    place = moved[block(model, "position")]
    turn = rotation_matrix(moved[block(model, "attitude")])
    rows = [ca.dot(planes[:3, j], place) - planes[3, j] for j in range(problem.planes)]
    values = ca.vertcat(*rows, np.cos(problem.tilt_max) - turn[2, 2])
    found = ca.substitute([values, ca.jacobian(values, d)], [d], [ca.DM.zeros(d.shape)])
    return ca.Function("tube_limits", [x, planes], [ca.densify(v) for v in found])


def _spread(
    model: ModelFunctions,
    problem: TubeProblem,
    gain: FloatArray,
    estimate: FloatArray,
    fresh: FloatArray,
    white: bool,
) -> ca.Function:
    """(x, u, p, Z, c, b) -> total, Z+, c+, b+; see the note at the top of the file."""
    n = model.sizes
    nd, ng, nt = n["n_d"], n["n_g"], n["n_theta"]
    x, u, p = _arguments(model)
    z = ca.MX.sym("Z", nd, nd)
    c, b = ca.MX.sym("c", nd, ng), ca.MX.sym("b", nd, nt)
    known = {"x": x, "u": u, "p": p, "K": ca.DM(gain), "S": z}
    known |= {"c": ca.MX(nd, ng) if white else c} if ng else {}
    step = model["consider_step"].call(known | ({"b": b} if nt else {}))
    # That step adds the noise of an open loop; here the estimate's innovations come in its place.
    after = step["S_next"] - ca.DM(model.noise.process)
    added = ca.DM(fresh)
    total = ca.DM(estimate) + step["total"]
    c_next, b_next = step.get("c_next", c), step.get("b_next", b)
    if ng and white:
        # from nothing, what comes after one step is the push alone
        added, c_next = added + c_next @ c_next.T, c
    if problem.kind == "worst case":
        ratio = ca.sqrt(ca.trace(after) / ca.fmax(ca.trace(added), 1e-30))
        # at the start there is nothing to add to
        some = ca.trace(after) > 0
        z_next = ca.if_else(
            some, (1 + 1 / ca.fmax(ratio, 1e-12)) * after + (1 + ratio) * added, added
        )
    else:
        z_next = after + added
    return ca.Function(
        "tube_spread", [x, u, p, z, c, b], [ca.densify(v) for v in (total, z_next, c_next, b_next)]
    )
