"""Curvature: the Hessian along a search, with what Gauss-Newton's leaves out.

The Gauss-Newton (expected) Hessian is the true one where the model is right. Where something is
missing the innovations are larger than they are expected to be, in ways that change with the
parameters, and steps cross a curved valley to and fro. What is missing is learned from the changes
of the gradient (Dennis, Gay and Welsch 1981, An adaptive nonlinear least-squares algorithm, ACM
Trans. Mathematical Software 7(3): structured secant, sizing, switching of models).
"""

from __future__ import annotations

import numpy as np

from greybox.estimation.solver import Value
from greybox.symbolic import FloatArray


class Curvature:
    """The Hessian (n, n) along a search in n unknowns: Gauss-Newton's, or that with what its steps
    showed to be missing, whichever foretold the last step better."""

    def __init__(self, n: int) -> None:
        self._missing = np.zeros((n, n))
        self._last: tuple[FloatArray, Value] | None = None

    def at(self, x: FloatArray, value: Value) -> FloatArray:
        """The Hessian to use at x (n,), the next point of the search, where the cost has this
        value."""
        assert value.gradient is not None and value.hessian is not None
        plain, trusted = value.hessian, False
        if self._last is not None:
            before, was = self._last
            assert was.gradient is not None and was.hessian is not None
            step, fall = x - before, was.cost - value.cost
            slope = float(was.gradient @ step)
            off = [
                abs(-slope - 0.5 * float(step @ m @ step) - fall)
                for m in (was.hessian, was.hessian + self._missing)
            ]
            trusted = off[1] < off[0]
            self._missing = with_secant(self._missing, step, value.gradient - was.gradient, plain)
        self._last = (x, value)
        whole = plain + self._missing
        return whole if trusted and definite(whole) else plain


def with_secant(
    missing: FloatArray, step: FloatArray, change: FloatArray, plain: FloatArray
) -> FloatArray:
    """What is missing of the Hessian (n, n), so that next to `plain` it explains by how much the
    gradient changed along the step (both (n,)); as it was where that does not rise."""
    rise = float(change @ step)
    if rise <= 0:
        return missing
    rest = change - plain @ step
    size = abs(float(step @ missing @ step))
    if size > 0:
        missing = missing * min(1.0, abs(float(step @ rest)) / size)
    off = rest - missing @ step
    both = np.outer(off, change)
    return missing + (both + both.T) / rise - float(off @ step) * np.outer(change, change) / rise**2


def definite(h: FloatArray) -> bool:
    """Whether a matrix (n, n) is clearly positive definite, in units of its diagonal."""
    diagonal = np.diag(h)
    if not (diagonal > 0).all():
        return False
    root = np.sqrt(diagonal)
    return bool(np.linalg.eigvalsh(h / np.outer(root, root))[0] > 1e-10)
