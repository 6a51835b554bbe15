"""Kink: a place where the slope of a cost jumps, as at a delay of whole samples.

A step across it fails however short it is, and the cost may have its minimum there. Where two
delays add up, the kink lies across both. A search that is held to it goes on along it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from greybox.estimation.solver import Objective, Value
from greybox.symbolic import BoolArray, FloatArray

BESIDE = 0.1
"""How far along a step that fails a kink is looked for, in standard errors."""
HALVINGS = 4
"""How often the way on which a slope changes its sign is halved."""
JUMPS = 0.75
"""Share of the change of a slope that is left on the last of these ways where it jumps. Where it
bends a sixteenth is left."""
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

    def at(part: float) -> tuple[float, FloatArray, Value]:
        there = np.clip(x + part * step, problem.lower, problem.upper)
        return part, there, problem.evaluate(there)

    def changed() -> FloatArray:
        """The change of the gradient on the way, beyond what the Hessian says."""
        assert near[2].gradient is not None and far[2].gradient is not None
        bent = (far[0] - near[0]) * (h @ step)
        return np.where(but, 0.0, far[2].gradient - near[2].gradient - bent) / size

    size = np.sqrt(np.maximum(np.diag(h), 1e-300))
    length = np.sqrt(max(float(step @ h @ step), 1e-300))
    near, far = (0.0, x, value), at(min(BESIDE / length, 1.0))
    if not (_slope(near[2], step) < 0.0 < _slope(far[2], step)):
        return None, 1
    whole = np.linalg.norm(changed())
    for _ in range(HALVINGS):
        middle = at(0.5 * (near[0] + far[0]))
        if not np.isfinite(_slope(middle[2], step)):
            return None, 1 + HALVINGS
        near, far = (middle, far) if _slope(middle[2], step) < 0.0 else (near, middle)
    jump = changed()
    rest = float(np.linalg.norm(jump))
    if rest == 0.0 or rest < JUMPS * whole:
        return None, 1 + HALVINGS
    _, lowest, best = min(near, far, key=lambda end: end[2].cost)
    return Kink(x=lowest, value=best, across=jump * size / rest), 1 + HALVINGS


def _slope(value: Value, step: FloatArray) -> float:
    return np.nan if value.gradient is None else float(value.gradient @ step)


def held_to(kinks: list[FloatArray], h: FloatArray) -> FloatArray:
    """A Hessian (n, n) that lets no step go across the `kinks` (each (n,))."""
    return h + FIRM * sum((np.outer(n, n) for n in kinks), np.zeros_like(h)) if kinks else h
