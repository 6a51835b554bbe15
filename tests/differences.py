"""Finite differences to judge gradients by."""

from __future__ import annotations

import numpy as np

from greybox.estimation.problem import Problem
from greybox.symbolic import FloatArray


def gradient_error(problem: Problem, theta: FloatArray, step: float = 1e-4) -> float:
    """Largest difference between the gradient and five-point differences of the cost, relative,
    unknowns scaled."""
    value = problem.evaluate(theta)
    assert value.gradient is not None
    slopes = np.zeros(problem.n)
    for j in range(problem.n):
        e = np.zeros(problem.n)
        e[j] = h = step * problem.scale[j]
        near = problem.evaluate(theta + e, 0).cost - problem.evaluate(theta - e, 0).cost
        far = problem.evaluate(theta + 2 * e, 0).cost - problem.evaluate(theta - 2 * e, 0).cost
        slopes[j] = (8 * near - far) / (12 * h)
    size = np.abs(value.gradient * problem.scale).max()
    return float(np.abs((slopes - value.gradient) * problem.scale).max() / size)
