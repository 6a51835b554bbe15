"""SciPy's trust-region reflective least squares on a small residual vector that is equivalent to
the whole cost.

With cost V, gradient g and Gauss-Newton Hessian H = L L' the n + 1 residuals

    r = (L^-1 g, sqrt(2 (V + c) - |L^-1 g|^2)),   J = (L', 0)

have r'r/2 = V + c, J'r = g and J'J = H exactly, whatever the criterion (log det, priors and robust
losses included), so that the trust-region steps are those of the full residual vector at a fraction
of its linear algebra. c makes the root real. (Branch, Coleman and Li 1999, SIAM J. Sci. Comput.
21(1), for the method and its bounds.)
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import scipy.linalg
import scipy.optimize

from greybox.estimation.solver import Objective, Progress, Value
from greybox.estimation.solvers.interior import on_bounds, standard_errors
from greybox.estimation.solvers.levenberg_marquardt import newton_decrement
from greybox.estimation.status import Code, Interrupted, Status
from greybox.symbolic import FloatArray


@dataclass(frozen=True, kw_only=True)
class ScipyTrf:
    """`scipy.optimize.least_squares(method="trf")`; stops by the same decrement as the other
    solvers."""

    name: str = "scipy-trf"
    tolerance: float = 1e-6
    max_iterations: int = 200

    def solve(
        self, problem: Objective, start: FloatArray, progress: Progress | None = None
    ) -> tuple[FloatArray, Status]:
        """Minimise from `start`; the best point and a status. Raises `Interrupted`, which holds
        both."""
        lower, upper = problem.lower, problem.upper
        x = np.clip(start, lower, upper)
        first = problem.evaluate(x)
        if not first.valid:
            return x, Status(code=Code.INVALID_START, iterations=0, evaluations=1, decrement=np.inf)
        residuals = _Residuals(
            problem=problem,
            scale=standard_errors(first, problem),
            tolerance=self.tolerance,
            progress=progress,
            offset=_offset(first),
        )
        low, high = _apart(problem)
        try:
            x, code, detail = self._search(
                residuals, x, (low / residuals.scale, high / residuals.scale)
            )
        except _Done as done:
            x, code, detail = done.x, Code.CONVERGED, ""
        except KeyboardInterrupt:
            x, code, detail = residuals.best, Code.INTERRUPTED, ""
        x = np.clip(x, lower, upper)
        status = Status(
            code=code,
            iterations=residuals.iterations,
            evaluations=residuals.evaluations,
            detail=detail,
            decrement=float(residuals.decrement),
        )
        if code is Code.INTERRUPTED:
            raise Interrupted((x, status))
        return x, status

    def _search(
        self, residuals: _Residuals, x: FloatArray, bounds: tuple[FloatArray, FloatArray]
    ) -> tuple[FloatArray, Code, str]:
        """Where scipy stops from x within scaled `bounds`, and why; begun again where the constant
        c must grow. Raises `_Done`."""
        while True:
            try:
                out = scipy.optimize.least_squares(
                    residuals.vector,
                    np.clip(x / residuals.scale, *bounds),
                    residuals.jacobian,
                    bounds,
                    method="trf",
                    x_scale="jac",
                    ftol=1e-15,
                    xtol=1e-13,
                    gtol=None,
                    tr_solver="exact",
                    max_nfev=max(self.max_iterations - residuals.iterations, 1),
                )
            except _RaiseOffset as again:
                x, residuals.offset = again.x, again.offset
                continue
            x = out.x * residuals.scale
            if residuals.decrement < 1e3 * self.tolerance:
                return x, Code.CONVERGED, ""
            code = Code.MAX_ITERATIONS if out.status == 0 else Code.NO_PROGRESS
            return x, code, str(out.message)


class _Done(Exception):
    """The decrement is small enough at x."""

    def __init__(self, x: FloatArray) -> None:
        self.x = x


class _RaiseOffset(Exception):
    """The constant c must grow: go on from x."""

    def __init__(self, x: FloatArray, offset: float) -> None:
        self.x, self.offset = x, offset


@dataclass(eq=False, kw_only=True)
class _Residuals:
    """Residuals and Jacobian in scaled unknowns; remembers the last point, which scipy asks for
    twice."""

    problem: Objective
    scale: FloatArray
    tolerance: float
    progress: Progress | None
    offset: float = 0.0
    iterations: int = 0
    evaluations: int = 1
    decrement: float = np.inf
    best: FloatArray = field(default_factory=lambda: np.zeros(0))
    _key: bytes = b""
    _last: Value | None = None

    def at(self, z: FloatArray) -> Value:
        if self._last is None or self._key != z.tobytes():
            self._last = self.problem.evaluate(
                np.clip(z * self.scale, self.problem.lower, self.problem.upper)
            )
            self._key = z.tobytes()
            self.evaluations += 1
        return self._last

    def vector(self, z: FloatArray) -> FloatArray:
        value = self.at(z)
        if not value.valid:
            return np.full(z.size + 1, np.inf)
        _, part = _whitened(value, self.scale)
        rest = 2 * (value.cost + self.offset) - float(part @ part)
        if rest <= 0:
            raise _RaiseOffset(z * self.scale, _offset(value))
        return np.append(part, np.sqrt(rest))

    def jacobian(self, z: FloatArray) -> FloatArray:
        value = self.at(z)
        assert value.gradient is not None and value.hessian is not None
        x = np.clip(z * self.scale, self.problem.lower, self.problem.upper)
        # trf keeps off the bounds.
        settled, held = on_bounds(x, value.gradient, value.hessian, self.problem)
        self.iterations += 1
        self.best = x
        self.decrement = newton_decrement(value.gradient, value.hessian, held)
        if self.progress:
            self.progress(self.iterations, value.cost, self.decrement)
        if self.decrement < self.tolerance:
            raise _Done(settled)
        root, _ = _whitened(value, self.scale)
        return np.vstack([root.T, np.zeros((1, z.size))])


def _apart(problem: Objective) -> tuple[FloatArray, FloatArray]:
    """The bounds: scipy refuses those that coincide, whose unknowns are held by a hair's
    breadth."""
    lower, upper = problem.lower, problem.upper
    same = ~(lower < upper)
    return (
        np.where(same, lower - 1e-12 * np.maximum(np.abs(lower), 1e-3 * problem.scale), lower),
        np.where(same, upper + 1e-12 * np.maximum(np.abs(upper), 1e-3 * problem.scale), upper),
    )


def _whitened(value: Value, scale: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(L, L^-1 g) of the scaled Hessian; a trace of damping where it is singular."""
    assert value.gradient is not None and value.hessian is not None
    h = value.hessian * np.outer(scale, scale)
    diagonal = np.maximum(np.diag(h), 1e-300)
    for damping in (0.0, 1e-12, 1e-9, 1e-6):
        try:
            root = np.asarray(np.linalg.cholesky(h + damping * np.diag(diagonal)), dtype=np.float64)
            break
        except np.linalg.LinAlgError:
            continue
    else:
        w, v = np.linalg.eigh(h)
        root = np.asarray(
            np.linalg.cholesky((v * np.maximum(w, 1e-6 * w[-1])) @ v.T), dtype=np.float64
        )
    part: FloatArray = scipy.linalg.solve_triangular(root, value.gradient * scale, lower=True)
    return root, part


def _offset(value: Value) -> float:
    """c with room: ten times what the root needs here."""
    assert value.gradient is not None and value.hessian is not None
    _, part = _whitened(value, np.ones_like(value.gradient))
    return max(0.0, -value.cost) + abs(value.cost) + 5.0 * float(part @ part) + 100.0
