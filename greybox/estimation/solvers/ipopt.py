"""IPOPT (Wachter and Biegler 2006, Math. Program. 106(1)) on the cost, with gradient and Hessian
supplied through CasADi.

`hessian="gauss-newton"` gives it the Hessian that the other solvers use (Fisher information);
"exact" gives central differences of the exact gradient, 2 n evaluations each: slow, for checking
and for problems with large misfit.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import casadi as ca
import numpy as np

from greybox.estimation.solver import Objective, Progress, Value
from greybox.estimation.solvers.interior import on_bounds, standard_errors
from greybox.estimation.solvers.levenberg_marquardt import newton_decrement
from greybox.estimation.status import Code, Interrupted, Status
from greybox.symbolic import Expr, FloatArray


@dataclass(frozen=True, kw_only=True)
class Ipopt:
    """Interior point with an exact gradient. `tolerance` is on the decrement of the cost, as in the
    other solvers."""

    name: str = "ipopt"
    hessian: Literal["gauss-newton", "exact"] = "gauss-newton"
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
        scale = standard_errors(first, problem)
        memory = _Memory(problem=problem, scale=scale, tolerance=self.tolerance, progress=progress)
        z = ca.MX.sym("z", problem.n)
        # CasADi does not keep what is computed by Python: these must live as long as the solver.
        cost = _Cost(memory)
        slopes = {
            "grad_f": _Gradient(memory),
            "hess_lag": _Hessian(memory, self.hessian == "exact"),
        }
        settings = {**self._options(), **slopes}
        solver = ca.nlpsol("solver", "ipopt", {"x": z, "f": cost(z)}, settings)
        out = solver(x0=x / scale, lbx=lower / scale, ubx=upper / scale)
        stats = solver.stats()
        x = np.clip(np.asarray(out["x"].full()).ravel() * scale, lower, upper)
        last = problem.evaluate(x)
        decrement = np.inf
        if last.valid and last.gradient is not None and last.hessian is not None:
            x, held = on_bounds(x, last.gradient, last.hessian, problem)
            decrement = newton_decrement(last.gradient, last.hessian, held)
        code, detail = _code(str(stats["return_status"]), decrement, self.tolerance)
        if memory.interrupted:
            code, detail = Code.INTERRUPTED, ""
        status = Status(
            code=code,
            iterations=int(stats["iter_count"]),
            evaluations=memory.evaluations,
            decrement=float(decrement),
            detail=detail,
        )
        if code is Code.INTERRUPTED:
            raise Interrupted((x, status))
        return x, status

    def _options(self) -> dict[str, bool | int | float | str]:
        return {
            "no_nlp_grad": True,
            "print_time": False,
            "error_on_fail": False,
            "ipopt.print_level": 0,
            "ipopt.sb": "yes",
            "ipopt.max_iter": self.max_iterations,
            "ipopt.tol": 1e-2 * np.sqrt(self.tolerance),
            "ipopt.dual_inf_tol": 1e3,
            "ipopt.bound_relax_factor": 0.0,
            "ipopt.nlp_scaling_method": "none",
            "ipopt.acceptable_iter": 0,
            "ipopt.mu_init": 1e-2,
            "ipopt.mu_strategy": "adaptive",
        }


def _code(status: str, decrement: float, tolerance: float) -> tuple[Code, str]:
    if decrement < (tolerance if status != "Solve_Succeeded" else 100 * tolerance):
        return Code.CONVERGED, ""
    if status == "Maximum_Iterations_Exceeded":
        return Code.MAX_ITERATIONS, ""
    return Code.SOLVER_FAILED, f"IPOPT: {status}"


@dataclass(eq=False, kw_only=True)
class _Memory:
    """Evaluations at scaled unknowns; the last point is remembered, because IPOPT asks for its
    parts one by one."""

    problem: Objective
    scale: FloatArray
    tolerance: float
    progress: Progress | None
    evaluations: int = 1
    iterations: int = 0
    interrupted: bool = False
    _key: bytes = b""
    _last: Value | None = None

    def at(self, z: FloatArray) -> Value:
        if self._last is None or self._key != z.tobytes():
            self._last = self.problem.evaluate(z * self.scale)
            self._key = z.tobytes()
            self.evaluations += 1
        return self._last

    def gradient(self, z: FloatArray) -> FloatArray:
        value = self.at(z)
        if not value.valid or value.gradient is None:
            return np.full(z.size, np.nan)
        return value.gradient * self.scale

    def difference_hessian(self, z: FloatArray) -> FloatArray:
        h = np.zeros((z.size, z.size))
        step = 1e-3  # thousandths of a standard error of the start
        low, high = self.problem.lower / self.scale, self.problem.upper / self.scale
        for j in range(z.size):
            up, down = z.copy(), z.copy()
            up[j], down[j] = min(z[j] + step, high[j]), max(z[j] - step, low[j])
            if up[j] > down[j]:
                slopes = [self.problem.evaluate(v * self.scale).gradient for v in (up, down)]
                self.evaluations += 2
                if slopes[0] is None or slopes[1] is None:
                    return np.full_like(h, np.nan)
                h[:, j] = (slopes[0] - slopes[1]) * self.scale / (up[j] - down[j])
        return 0.5 * (h + h.T)


class _Callback(ca.Callback):
    """A CasADi function of the scaled unknowns that is computed by Python."""

    def __init__(self, memory: _Memory) -> None:
        ca.Callback.__init__(self)
        self.memory = memory
        self.n = memory.problem.n
        self.construct(type(self).__name__.strip("_").lower(), {})

    def _z(self, arg: Sequence[ca.DM]) -> FloatArray:
        return np.asarray(arg[0].full()).ravel()

    def eval(self, arg: Sequence[ca.DM]) -> list[Expr | float]:
        """Compute; an interrupt from the keyboard ends the solver."""
        try:
            return self.compute(arg)
        except KeyboardInterrupt:
            self.memory.interrupted = True
            raise

    @abstractmethod
    def compute(self, arg: Sequence[ca.DM]) -> list[Expr | float]:
        """The function itself."""


class _Cost(_Callback):
    """f(z)."""

    def get_n_in(self) -> int:
        return 1

    def get_n_out(self) -> int:
        return 1

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(self.n, 1)

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(1, 1)

    def compute(self, arg: Sequence[ca.DM]) -> list[Expr | float]:
        value = self.memory.at(self._z(arg))
        return [value.cost if value.valid else np.nan]


class _Gradient(_Callback):
    """(z, p) -> f, gradient."""

    def get_n_in(self) -> int:
        return 2

    def get_n_out(self) -> int:
        return 2

    def get_name_in(self, i: int) -> str:
        return ("x", "p")[i]

    def get_name_out(self, i: int) -> str:
        return ("f", "grad_f_x")[i]

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(self.n if i == 0 else 0, 1) if i == 0 else ca.Sparsity(0, 0)

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(1 if i == 0 else self.n, 1)

    def compute(self, arg: Sequence[ca.DM]) -> list[Expr | float]:
        z = self._z(arg)
        value = self.memory.at(z)
        return [value.cost if value.valid else np.nan, self.memory.gradient(z)]


class _Hessian(_Callback):
    """(z, p, lam_f, lam_g) -> upper triangle of the Hessian of the Lagrangian."""

    def __init__(self, memory: _Memory, exact: bool) -> None:
        self.exact = exact
        super().__init__(memory)

    def get_n_in(self) -> int:
        return 4

    def get_n_out(self) -> int:
        return 1

    def get_name_in(self, i: int) -> str:
        return ("x", "p", "lam_f", "lam_g")[i]

    def get_name_out(self, i: int) -> str:
        return "triu_hess_gamma_x_x"

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return (
            ca.Sparsity.dense(self.n, 1),
            ca.Sparsity(0, 0),
            ca.Sparsity.dense(1, 1),
            ca.Sparsity(0, 0),
        )[i]

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.upper(self.n)

    def compute(self, arg: Sequence[ca.DM]) -> list[Expr | float]:
        z = self._z(arg)
        memory = self.memory
        value = memory.at(z)
        if memory.progress and value.gradient is not None and value.hessian is not None:
            memory.iterations += 1
            memory.progress(
                memory.iterations,
                value.cost,
                newton_decrement(value.gradient, value.hessian, np.zeros(z.size, dtype=bool)),
            )
        if not value.valid or value.hessian is None:
            h = np.full((z.size, z.size), np.nan)
        elif self.exact:
            h = memory.difference_hessian(z)
        else:
            h = value.hessian * np.outer(memory.scale, memory.scale)
        return [ca.triu(ca.DM(float(arg[2]) * h))]
