"""Offset-free targets: the steady state and command that hold a reference under the estimated
disturbance.

With disturbance states in the model, the steady state that the disturbed model needs has no offset
in what it tracks (Pannocchia and Rawlings 2003, AIChE J. 49(2); Maeder, Borrelli and Morari 2009,
Automatica 45(10)). The conditions

    boxminus(f_d(x, u), x) = 0  (without the disturbances, which the target takes as they are),   tracked(x) = r

are solved by Newton steps in error coordinates, each scaled to typical sizes and solved in the
least-squares sense. A history of commands is at rest: every earlier command is the present one.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence

import casadi as ca
import numpy as np

from greybox.errors import ModelError
from greybox.frames import euler_zyx
from greybox.model.layer import physics_of
from greybox.model.noise import UNMOVED
from greybox.symbolic import Expr, FloatArray, Layout, Signal
from mpc_export.sampled import Sampled

RIDGE = 1e-3
"""Rows of this size times the identity stand under the conditions, whose own rows have length one:
where conditions are fewer than unknowns, single precision needs them, and Newton steps stay as
quick."""
ANGLES = ("phi", "theta", "psi")
SIZES = {
    **{"d_position": 1.0, "d_velocity": 1.0, "d_attitude": 0.3, "d_rate": 1.0},
    **{"d_rotor": 0.3, "d_rotor_shown": 0.3},
    **{"d_rotor_pull": 0.3, "d_rotor_shown_pull": 0.3},
}


def tracked(sampled: Sampled) -> Layout:
    """What the target holds: position or else velocity (world) with the heading psi, or else the
    attitude (phi, theta, psi), or else the rates; of models that do not fly as many outputs as
    there are commands. Angles are ZYX, in rad."""
    names = sampled.dynamics.states.names
    for block in ("position", "velocity"):
        if f"{block}.x" in names and "attitude.w" in names:
            rows = [
                sampled.dynamics.states.signals[sampled.dynamics.states[f"{block}.{a}"]]
                for a in "xyz"
            ]
            return Layout([*rows, Signal(name="psi", unit="rad", meaning="heading, ZYX")])
    if "attitude.w" in names:
        return Layout([Signal(name=n, unit="rad", meaning="Euler angle, ZYX") for n in ANGLES])
    if "rate.x" in names:
        return Layout(
            [sampled.dynamics.states.signals[sampled.dynamics.states[f"rate.{a}"]] for a in "xyz"]
        )
    return Layout(list(sampled.dynamics.outputs)[: len(sampled.inputs)])


def _held(sampled: Sampled, targets: Layout, x: Expr, y: Expr) -> Expr:
    states, outputs = sampled.dynamics.states, sampled.dynamics.outputs
    rows = []
    for n in targets.names:
        if n in ANGLES and "attitude.w" in states:
            rows.append(euler_zyx(x[[states[f"attitude.{a}"] for a in "wxyz"]])[ANGLES.index(n)])
        elif n in states:
            rows.append(x[states[n]])
        else:
            rows.append(y[outputs[n]])
    return ca.vertcat(*rows)


def target_function(
    sampled: Sampled, functions: Mapping[str, ca.Function], targets: Layout, n_p: int
) -> ca.Function:
    """target_step(x, u, p, r) -> x_next, u_next, residual (a scalar: largest condition that x, u
    still miss, scaled).

    Call it a few times from any start; the disturbances in x stay. Raises `ModelError` for a model
    without commands.
    """
    if not len(sampled.inputs):
        raise ModelError("a model without commands has no target")
    nd, nu = len(sampled.error_states), len(sampled.inputs)
    own = len(sampled.dynamics.error_states)
    names = sampled.error_states.names
    unmoved = tuple(f"d_{kind}." for kind in UNMOVED)
    moving = [i for i in range(own) if not names[i].startswith(unmoved)]
    size = _sizes(sampled, moving)
    scale = np.concatenate([size, np.full(nu, 0.3)])
    x, u, p = ca.MX.sym("x", len(sampled.states)), ca.MX.sym("u", nu), ca.MX.sym("p", n_p)
    r = ca.MX.sym("r", len(targets))
    # The history is that of the present command.
    order = [sampled.inputs[sampled.dynamics.inputs.names[i]] for i, _ in sampled.history]
    held = ca.DM(len(order), nu)
    for k, i in enumerate(order):
        held[k, i] = 1.0
    still = ca.vertcat(x[: len(sampled.dynamics.states)], held @ u)
    after, a, b, _ = functions["f_d_jac"](still, u, p)
    b = b + a[:, own:] @ held if order else b
    change = functions["boxminus"](after, still)
    # d boxminus(f_d(x+d), x+d)/dd, to first order at a small change.
    slope = (a - ca.DM.eye(nd))[moving, moving]
    y, c, d, _ = functions["h_jac_raw"](still, u, p)
    missing, by_state, by_output, chart = _missing(sampled, targets, moving, y.numel())(still, y, r)
    c, d = by_output @ c @ chart, by_output @ d
    rhs = ca.vertcat(-change[moving] / size, missing)
    top = ca.horzcat(slope, b[moving, :])
    top = top * ca.repmat(ca.DM(scale).T, len(moving), 1) / ca.repmat(ca.DM(size), 1, len(scale))
    low = ca.horzcat(by_state + c, d) * ca.repmat(ca.DM(scale).T, len(targets), 1)
    step = _least_squares(len(moving) + len(targets), len(scale))(ca.vertcat(top, low), rhs) * scale
    spread = ca.DM(nd, len(moving))
    for k, i in enumerate(moving):
        spread[i, k] = 1.0
    new_u = u + step[len(moving) :]
    new_x = functions["boxplus"](still, ca.densify(spread @ step[: len(moving)]))
    new_x = ca.vertcat(new_x[: len(sampled.dynamics.states)], held @ new_u)
    return ca.Function(
        "target_step",
        [x, u, p, r],
        [new_x, new_u, ca.mmax(ca.fabs(rhs))],
        ["x", "u", "p", "r"],
        ["x_next", "u_next", "residual"],
    )


def _sizes(sampled: Sampled, moving: Sequence[int]) -> FloatArray:
    """Typical sizes of the error states `moving`."""
    physics = physics_of(sampled.dynamics)
    own: Mapping[str, float] = {} if physics is None else physics.memory_sizes
    sizes = SIZES | {f"d_{n}": v for n, v in own.items()}
    names = [sampled.error_states.names[i] for i in moving]
    return np.array([sizes.get(n, sizes.get(n.rpartition(".")[0], 1.0)) for n in names])


def _missing(sampled: Sampled, targets: Layout, moving: Sequence[int], n_y: int) -> ca.Function:
    """(x, y, r) -> what the targets miss of r, the slopes of what they hold in the error states
    `moving` and in y, and the slopes of x in those error states."""
    x, y = ca.SX.sym("x", len(sampled.states)), ca.SX.sym("y", n_y)
    r = ca.SX.sym("r", len(targets))
    value = _held(sampled, targets, x, y)
    into, _ = sampled.chart(x, x)
    # An angle is reached the short way round.
    rows = [r[i] - value[i] for i in range(len(targets))]
    away = ca.vertcat(
        *(ca.atan2(ca.sin(v), ca.cos(v)) if n in ANGLES else v for n, v in zip(targets.names, rows))
    )
    parts = (away, ca.jacobian(value, x) @ into[:, moving], ca.jacobian(value, y), into[:, moving])
    return ca.Function("held", [x, y, r], [ca.densify(v) for v in parts])


@functools.cache
def _least_squares(rows: int, columns: int) -> ca.Function:
    """(J, r) -> the least-squares solution of J d = r, rows balanced first, with a tiny ridge under
    it.

    Modified Gram-Schmidt of [J r], which is backward stable (Bjorck 1967, BIT 7), in whole columns.
    """
    j, r = ca.MX.sym("J", rows, columns), ca.MX.sym("r", rows)
    weight = 1 / ca.sqrt(ca.sum2(j * j) + 1e-30)
    top = ca.horzcat(j * ca.repmat(weight, 1, columns), r * weight)
    m = ca.densify(ca.vertcat(top, ca.horzcat(RIDGE * ca.DM.eye(columns), ca.DM.zeros(columns, 1))))
    left, upper = ca.horzsplit(m), []
    for k in range(columns):
        q = left[k] / ca.norm_2(left[k])
        row = [ca.dot(q, v) for v in left[k:]]
        upper.append(ca.horzcat(ca.DM.zeros(1, k), *row))
        left[k + 1 :] = [v - r * q for v, r in zip(left[k + 1 :], row[1:], strict=True)]
    u = ca.SX.sym("R", columns, columns + 1)
    x: list[Expr] = [ca.SX(0)] * columns
    for i in reversed(range(columns)):
        rest = u[i, columns]
        for k in range(i + 1, columns):
            rest = rest - u[i, k] * x[k]
        x[i] = rest / u[i, i]
    back = ca.Function("back_substitution", [u], [ca.vertcat(*x)])
    return ca.Function("least_squares", [j, r], [back(ca.vertcat(*upper))])
