"""What solvers of other libraries need of a problem: its unknowns in standard errors, and those
that an interior method leaves next to their bound."""

from __future__ import annotations

import numpy as np

from greybox.estimation.solver import Objective, Value
from greybox.symbolic import BoolArray, FloatArray

NEAR = 1e-3
"""Distance from a bound, in standard errors, that counts as on it."""


def standard_errors(value: Value, problem: Objective) -> FloatArray:
    """Standard errors (n,) of single unknowns: the scaled Hessian has a unit diagonal."""
    assert value.hessian is not None
    diagonal = np.diag(value.hessian)
    return np.where(diagonal > 0, 1.0 / np.sqrt(np.maximum(diagonal, 1e-300)), problem.scale)


def on_bounds(
    x: FloatArray, gradient: FloatArray, hessian: FloatArray, problem: Objective
) -> tuple[FloatArray, BoolArray]:
    """(x with the unknowns on their bound that the cost pushes out of it, which those are)."""
    near = NEAR / np.sqrt(np.maximum(np.diag(hessian), 1e-300))
    down = (x <= problem.lower + near) & (gradient > 0)
    up = (x >= problem.upper - near) & (gradient < 0)
    return np.where(down, problem.lower, np.where(up, problem.upper, x)), down | up
