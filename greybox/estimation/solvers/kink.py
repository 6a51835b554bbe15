"""Kink: a place where the slope of a cost jumps, as at a delay of whole samples.

A step across it fails however short it is, and the cost may have its minimum there. Where two
delays add up, the kink lies across both. A search that is held to it goes on along it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from greybox.estimation.solver import Objective, Value
from greybox.symbolic import BoolArray, FloatArray

BESIDE = 0.1
"""How far along a step that fails a kink is looked for, in standard errors."""
CLOSE = 1e-6
"""How closely its place is found, as a share of that."""
END = 0.99
"""Share of that beyond which the lowest point is its end: the cost falls on, across no kink."""
JUMPS = 0.75
"""Share of the change of a slope that is left on half the way where it jumps; where it bends, half
is."""
FIRM = 1e6
"""Curvature across a kink, where a search is held to it, in units of the Hessian's diagonal."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Kink:
    """The lowest point `x` (n,) that was met at a kink, the `value` there, and the direction
    `across` (n,): the jump of the gradient, of length one in units of the Hessian's diagonal."""

    x: FloatArray
    value: Value
    across: FloatArray


def kink_near(
    problem: Objective, x: FloatArray, value: Value, step: FloatArray, h: FloatArray, but: BoolArray
) -> tuple[Kink | None, int]:
    """(The kink that a full step (n,) from x with the Hessian `h` would cross `BESIDE` x, None
    where the slope does not jump; evaluations). Unknowns `but` (n,) have no part in a kink."""

    def at(part: float) -> FloatArray:
        return np.clip(x + part * step, problem.lower, problem.upper)

    def cost(part: float) -> float:
        """Where nothing can be predicted it is large: the search for the lowest divides."""
        there = problem.evaluate(at(part), 0).cost
        return there if np.isfinite(there) else 10 * abs(value.cost) + 1e6

    def change(half: float) -> tuple[FloatArray, Value, Value]:
        """That of the gradient about the lowest point, in units of the Hessian's diagonal."""
        ends = [problem.evaluate(at(lowest + way * half)) for way in (-1.0, 1.0)]
        a, b = (np.full(x.size, np.nan) if e.gradient is None else e.gradient for e in ends)
        turns = float(a @ step) < 0.0 < float(b @ step)
        jump = np.where(but, 0.0, b - a) / size if turns else np.full(x.size, np.nan)
        return jump, ends[0], ends[1]

    size = np.sqrt(np.maximum(np.diag(h), 1e-300))
    whole = min(BESIDE / np.sqrt(max(float(step @ h @ step), 1e-300)), 1.0)
    if cost(whole) < min(cost(END * whole), value.cost):
        return None, 2
    found = minimize_scalar(
        cost,
        bounds=(0.0, whole),
        method="bounded",
        options={"xatol": CLOSE * whole, "maxiter": 60},
    )
    lowest, tried = float(found.x), int(found.nfev) + 2
    if not lowest < END * whole:
        return None, tried
    wide, tried = change(4 * CLOSE * whole), tried + 2
    if not np.isfinite(wide[0]).all() or not wide[0].any():
        return None, tried
    (jump, *ends), tried = change(2 * CLOSE * whole), tried + 2
    rest = float(np.linalg.norm(jump))
    if not rest >= JUMPS * np.linalg.norm(wide[0]):
        return None, tried
    way, best = min(zip((-1.0, 1.0), ends, strict=True), key=lambda end: end[1].cost)
    there = at(lowest + way * 2 * CLOSE * whole)
    if best.cost > value.cost:
        there, best = x, value
    return Kink(x=there, value=best, across=jump * size / rest), tried


def held_to(kinks: list[FloatArray], h: FloatArray) -> FloatArray:
    """A Hessian (n, n) that lets no step go across the `kinks` (each (n,))."""
    return h + FIRM * sum((np.outer(n, n) for n in kinks), np.zeros_like(h)) if kinks else h
