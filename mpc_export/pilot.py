"""pilot_step: one sample of a filter and a linear feedback, as one function that an autopilot can
call.

    x_next = follow_step(x, u, p, y, there), or filter_step of a model without disturbances
    x_r    = hover at r = (position, heading), moved to what holds it there against the disturbances in x_next
    u_next = the command of that steady state + K (x_next boxminus x_r), within the limits of the commands

u is in force from this sample to the next, u_next from then on: what the sample takes to compute is
part of the model. The steady state is that of target.py to first order about hover, two constant
matrices; disturbances act in body axes, so that they hold for every heading. What is given from
outside, such as the battery's voltage, moves it by a parabola in reference / value - 1: a command
that is inversely proportional to the voltage is exact. Places and speeds farther from it than NEAR
count as that far. There are no limits but those of the commands.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from greybox.errors import ModelError
from greybox.frames import quat_multiply
from greybox.symbolic import FloatArray, Layout
from mpc_export.feedback import NEAR, Weights, cost, demand_flight, hover, lqr, rows, steered
from mpc_export.sampled import EXOGENOUS


@dataclass(frozen=True, kw_only=True, eq=False)
class Pilot:
    """Hover x (n_x,), u (n_u,), gain K (n_u, n_d), and what holds against disturbances of size one
    (n_d, n_w), (n_u, n_w); empty without pilot_step.

    given: (row of p, its reference) of what comes from outside; per one, the parabolas by which it
    moves hover, given_x (n_d, 2) and given_u (n_u, 2), of z and z^2, z = reference / value - 1.
    """

    x: FloatArray
    u: FloatArray
    gain: FloatArray
    moved: FloatArray
    held: FloatArray
    given: tuple[tuple[int, float], ...] = ()
    given_x: tuple[FloatArray, ...] = ()
    given_u: tuple[FloatArray, ...] = ()


UNPILOTED = Pilot(
    x=np.zeros(0),
    u=np.zeros(0),
    gain=np.zeros((0, 0)),
    moved=np.zeros((0, 0)),
    held=np.zeros((0, 0)),
)
SMALL = 1e-4
"""Disturbance [N, N m] by which the slopes of the steady state are taken."""
SPAN = 0.2
"""z at whose two signs the steady state is solved for what is given from outside."""
LOWEST = 0.5
"""Part of its reference below which a given value counts as that much."""


def _parabola(
    functions: Mapping[str, ca.Function],
    states: Layout,
    at_rest: tuple[FloatArray, FloatArray],
    p: FloatArray,
    row: int,
) -> tuple[FloatArray, FloatArray]:
    """How p[row] moves hover (x, u): coefficients (n_d, 2), (n_u, 2) of z and z^2."""
    x, u = at_rest
    ends = []
    for z in (SPAN, -SPAN):
        other = p.copy()
        other[row] = p[row] / (1.0 + z)
        moved, command = hover(functions, states, (x, u), other, 4)
        ends.append((functions["boxminus"](moved, x).full().ravel(), command - u))
    (x_up, u_up), (x_down, u_down) = ends
    return _bent(x_up, x_down), _bent(u_up, u_down)


def _bent(up: FloatArray, down: FloatArray) -> FloatArray:
    """Coefficients (n, 2) of z and z^2 of the parabola through 0, up at SPAN and down at -SPAN."""
    return np.column_stack([(up - down) / (2 * SPAN), (up + down) / (2 * SPAN**2)])


def pilot_function(
    functions: Mapping[str, ca.Function],
    layouts: tuple[Layout, Layout, Layout],
    name: str,
    point: tuple[FloatArray, FloatArray, FloatArray],
    limits: tuple[FloatArray, FloatArray],
) -> tuple[ca.Function, Pilot]:
    """(pilot_step, its numbers) of a model with filter_step and target_step.

    layouts: states, error states, parameters; point: (x, u, p) to look for hover from; limits of the commands.
    Raises `ModelError` for what is no aircraft, or has commands without limits.
    """
    states, errors, parameters = layouts
    x0, u0, p0 = point
    lower, upper = limits
    demand_flight(states, name)
    if not (len(u0) and np.isfinite(lower).all() and np.isfinite(upper).all()):
        raise ModelError(
            f"{name} has commands without limits",
            got=f"{lower.tolist()} to {upper.tolist()}",
            fix="speed_max of the actuator in the vehicle file",
        )
    x, u = hover(functions, states, (x0, u0), p0, 4)
    _, a, b, _ = (v.full() for v in functions["f_d_jac"](x, u, p0))
    q, r = cost(errors, len(u0), Weights())
    # weights are per unit of a command that runs from 0 to 1
    width = upper - lower
    gain, _ = lqr(a, b, q, r / np.outer(width, width), steered(functions, errors))
    pushes = [i for i, n in enumerate(states.names) if n.startswith("disturbance.")]
    moved, held = np.zeros((len(errors), len(pushes))), np.zeros((len(u0), len(pushes)))
    goal = np.zeros(4)
    for j, at in enumerate(pushes):
        pushed = x.copy()
        pushed[at] = SMALL
        steady, command, _ = functions["target_step"](pushed, u, p0, goal)
        moved[:, j] = functions["boxminus"](steady, x).full().ravel() / SMALL
        held[:, j] = (command.full().ravel() - u) / SMALL
    given = tuple((i, float(p0[i])) for i, n in enumerate(parameters.names) if n in EXOGENOUS)
    bent = [_parabola(functions, states, (x, u), p0, i) for i, _ in given]
    own = Pilot(
        x=x,
        u=u,
        gain=gain,
        moved=moved,
        held=held,
        given=given,
        given_x=tuple(b[0] for b in bent),
        given_u=tuple(b[1] for b in bent),
    )
    return _step(functions, (states, errors), own, limits), own


def _step(
    functions: Mapping[str, ca.Function],
    layouts: tuple[Layout, Layout],
    own: Pilot,
    limits: tuple[FloatArray, FloatArray],
) -> ca.Function:
    states, errors = layouts
    names = ("x", "u", "p", "y", "there")
    step = functions.get("follow_step", functions["filter_step"])
    arguments = [ca.MX.sym(n, step.size1_in(i)) for i, n in enumerate(names)]
    r = ca.MX.sym("r", 4)
    after, e, y_hat = step(*arguments)
    goal = ca.MX(ca.DM(own.x))
    goal[rows(states, "position")] = r[:3]
    turn = ca.vertcat(ca.cos(0.5 * r[3]), 0, 0, ca.sin(0.5 * r[3]))
    at = rows(states, "attitude")
    goal[at] = quat_multiply(turn, ca.DM(own.x[at]))
    pushes = after[rows(states, "disturbance")]
    moved, held = ca.mtimes(ca.DM(own.moved), pushes), ca.mtimes(ca.DM(own.held), pushes)
    p = arguments[names.index("p")]
    for (row, reference), by_x, by_u in zip(own.given, own.given_x, own.given_u):
        z = reference / ca.fmax(p[row], LOWEST * reference) - 1.0
        bend = ca.vertcat(z, z**2)
        moved, held = moved + ca.mtimes(ca.DM(by_x), bend), held + ca.mtimes(ca.DM(by_u), bend)
    steady = functions["boxplus"](goal, moved)
    away = functions["boxminus"](after, steady)
    share = ca.DM.ones(len(errors))
    for name, most in NEAR.items():
        mask = np.zeros(len(errors))
        mask[rows(errors, f"d_{name}")] = 1.0
        share = share + mask * (
            ca.fmin(1.0, most / ca.fmax(ca.sqrt(ca.sumsqr(mask * away)), 1e-9)) - 1.0
        )
    lower, upper = limits
    held = ca.fmin(ca.fmax(ca.DM(own.u) + held, lower), upper)
    command = ca.fmin(ca.fmax(held + ca.mtimes(ca.DM(own.gain), share * away), lower), upper)
    return ca.Function(
        "pilot_step",
        [*arguments, r],
        [ca.densify(v) for v in (after, command, e, y_hat)],
        [*names, "r"],
        ["x_next", "u_next", "e", "y_hat"],
    )
