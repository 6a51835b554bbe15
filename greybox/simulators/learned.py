"""Learned: what a model has learned beside its physics, as a force and a moment on the craft.

A simulator that flies the physics alone leaves it out. It is a function of the motion like any
effect, so that its size can be counted and it can be applied from outside.
"""

from __future__ import annotations

from functools import lru_cache

import casadi as ca
import numpy as np

from greybox.model.layer import LearnedPush, learned_push_of
from greybox.model.model import PhysicsModel
from greybox.residual.hybrid import HybridModel
from greybox.simulators.craft import Craft
from greybox.symbolic import Expr, FloatArray, evaluate

ROWS = ("force.x", "force.y", "force.z", "torque.x", "torque.y", "torque.z")


def has_learned(craft: Craft) -> bool:
    """Whether the craft's model has learned something beside its physics."""
    return learned_push_of(craft.source.dynamics) is not None


@lru_cache(maxsize=16)
def with_learned(craft: Craft) -> PhysicsModel | LearnedPush:
    """The craft's physics under what was learned beside it; the physics alone where nothing
    was."""
    push = learned_push_of(craft.source.dynamics)
    return craft.physics if push is None else push.on(craft.physics)


@lru_cache(maxsize=16)
def _function(hybrid: HybridModel) -> ca.Function:
    """(x, window of commands) -> learned force [N] and torque [N m], body axes (6)."""
    x = ca.SX.sym("x", len(hybrid.states))
    window = ca.SX.sym("u", len(hybrid.inputs), sum(hybrid.window) + 1)
    return ca.Function("learned", [x, window], [_wrench(hybrid, x, window)])


def _wrench(hybrid: HybridModel, x: Expr, window: Expr) -> Expr:
    out = ca.SX.zeros(6)
    mean = hybrid.learned_mean(x, window)
    for i, name in enumerate(hybrid.posterior.outputs.names):
        out[ROWS.index(name)] += mean[i]
    return out


def is_of_motion(craft: Craft) -> bool:
    """Whether what was learned looks at motion and rotor speeds alone."""
    sizes = {"position": 3, "velocity": 3, "attitude": 4, "rate": 3}
    blocks = {n: ca.SX.sym(n, k) for n, k in sizes.items()}
    return learned_wrench(craft, blocks, ca.SX.sym("nu", craft.count)) is not None


def learned_at(craft: Craft, states: FloatArray, inputs: FloatArray) -> FloatArray:
    """Learned force [N] and torque [N m] in body axes (6, n) at `states` (n_x, n) under commands
    (n_u, n) that have stood for long; zero where nothing was learned."""
    hybrid = with_learned(craft)
    if not isinstance(hybrid, HybridModel):
        return np.zeros((6, states.shape[1]))
    function, length = _function(hybrid), sum(hybrid.window) + 1
    return evaluate(function, states.T, np.tile(inputs.T, (1, length))).T


def learned_wrench(craft: Craft, blocks: dict[str, Expr], nu: Expr) -> Expr | None:
    """Learned force [N] and torque [N m] (6) of the craft's motion (`blocks` of its state) and
    rotor speeds; None where nothing was learned, or what was looks at more than these."""
    hybrid = with_learned(craft)
    if not isinstance(hybrid, HybridModel):
        return None
    parts = {n: blocks[n] for n in ("position", "velocity", "attitude", "rate")} | {"rotor": nu}
    seen = {f"{n}.{a}": v[i] for n, v in parts.items() for i, a in enumerate(_axes(n, v))}
    hidden = {n: ca.SX.sym(n) for n in hybrid.states.names if n not in seen}
    x = ca.vertcat(*({**seen, **hidden}[n] for n in hybrid.states.names))
    window = ca.SX.sym("u", len(hybrid.inputs), sum(hybrid.window) + 1)
    out = _wrench(hybrid, x, window)
    unknown = ca.vertcat(ca.vec(window), *hidden.values())
    return None if ca.depends_on(out, unknown) else out


def _axes(name: str, block: Expr) -> list[str]:
    if name == "rotor":
        return [str(i + 1) for i in range(block.shape[0])]
    return list("wxyz" if name == "attitude" else "xyz")
