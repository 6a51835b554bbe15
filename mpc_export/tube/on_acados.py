"""The tube's problem handed to acados (Verschueren et al. 2022, Mathematical Programming
Computation 14): Gauss-Newton, HPIPM, one thread; and in flight as zero-order robust optimisation.

The command before is a state. All but the last stage are integrals to acados, so their costs are
divided by the sample time.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import casadi as ca
import numpy as np

from greybox.symbolic import FloatArray
from mpc_export.acados import MAX_ITERATIONS, first_order, limit_slopes, robust_solve
from mpc_export.exported import of
from mpc_export.tube.problem_expressions import Problem
from mpc_export.tube.solver import Outcome, TubeSolver

if TYPE_CHECKING:
    from acados_template import AcadosOcpSolver


def acados_solver(
    problem: Problem,
    home: Path,
    work: Path,
    kind: Literal["SQP", "SQP_RTI"],
    *,
    tolerance: float,
    limited_end: bool = False,
    optimise: str = "-O3 -march=native",
) -> AcadosOcpSolver:
    """An `AcadosOcpSolver` inside a `mpc_export.acados.session` with its `home`; generated code
    goes to `work`. Parameters of a stage: ref, planes, x_end. limited_end: the last stage keeps
    the limits too. optimise: flags of the compiler."""
    from acados_template import AcadosModel, AcadosOcp, AcadosOcpSolver

    p, task = problem, problem.task
    ocp, model = AcadosOcp(), AcadosModel()
    model.name = f"tube_{kind.lower()}_{id(problem)}"
    x, u = ca.MX.sym("x", p.nx + p.nu), ca.MX.sym("u", p.nu)
    given = ca.MX.sym("p", 7 + p.nu + 4 * p.npl + p.nx)
    ref, planes, goal = ca.vertsplit(given, [0, 7 + p.nu, 7 + p.nu + 4 * p.npl, given.numel()])
    model.x, model.u, model.p = x, u, given
    step = first_order(of(p.model, model.name))
    after = step(x[: p.nx], u, p.model.parameter_values)
    model.disc_dyn_expr = ca.vertcat(after, u)
    model.cost_y_expr = p.residual(x[: p.nx], u, x[p.nx :], ref)
    model.cost_y_expr_e = p.end(x[: p.nx], goal)
    model.con_h_expr = p.limits(x[: p.nx], planes)
    ocp.model = model
    ocp.acados_include_path, ocp.acados_lib_path = str(home / "include"), str(home / "lib")
    ocp.code_export_directory = str(work / model.name)
    ocp.dims.N = p.n
    ocp.cost.cost_type = ocp.cost.cost_type_e = "NONLINEAR_LS"
    ny, ne = model.cost_y_expr.numel(), model.cost_y_expr_e.numel()
    ocp.cost.W, ocp.cost.W_e = np.eye(ny) / task.dt, np.eye(ne)
    ocp.cost.yref, ocp.cost.yref_e = np.zeros(ny), np.zeros(ne)
    c = ocp.constraints
    c.x0 = np.zeros(p.nx + p.nu)
    c.idxbu = np.arange(p.nu)
    c.lbu, c.ubu = np.full(p.nu, task.command_min), np.full(p.nu, task.command_max)
    c.C, c.D = np.hstack([np.zeros((p.nu, p.nx)), -np.eye(p.nu)]), np.eye(p.nu)
    c.lg, c.ug = np.full(p.nu, -task.rate_max), np.full(p.nu, task.rate_max)
    c.lh, c.uh, c.idxsh = np.full(p.nl, -100.0), np.zeros(p.nl), np.arange(p.nl)
    ocp.cost.zl = ocp.cost.zu = np.full(p.nl, task.penalty / task.dt)
    ocp.cost.Zl = ocp.cost.Zu = np.full(p.nl, task.penalty_square / task.dt)
    if limited_end:
        model.con_h_expr_e = p.limits(x[: p.nx], planes)
        c.lh_e, c.uh_e, c.idxsh_e = c.lh, c.uh, c.idxsh
        ocp.cost.zl_e = ocp.cost.zu_e = np.full(p.nl, task.penalty)
        ocp.cost.Zl_e = ocp.cost.Zu_e = np.full(p.nl, task.penalty_square)
    ocp.parameter_values = np.zeros(given.numel())
    options = ocp.solver_options
    options.tf, options.integrator_type = p.n * task.dt, "DISCRETE"
    options.hessian_approx = "GAUSS_NEWTON"
    options.nlp_solver_type, options.nlp_solver_max_iter = kind, 100
    options.qp_solver, options.qp_solver_iter_max = "PARTIAL_CONDENSING_HPIPM", 200
    options.tol, options.qp_tol = tolerance, 1e-2 * tolerance
    options.ext_fun_compile_flags = optimise
    return AcadosOcpSolver(ocp, json_file=str(work / f"{model.name}.json"), verbose=False)


class ZeroOrder:
    """In place of a controller's `TubeSolver`, whose `data` it reads and writes: zoRO on acados
    (Zanelli, Frey, Messerer and Diehl 2021), two real-time iterations a plan.

    The covariance is that of `covariance_step` under the same gain, begun at the filter's; errors
    of the learned part are fresh at every stage, those of parameters are not in it. planes
    (n_p, 4): the same at every time. kappa: standard deviations of every limit; commands are not
    tightened. Made inside a `mpc_export.acados.session` with its `home`.
    """

    def __init__(
        self,
        inner: TubeSolver,
        planes: FloatArray,
        kappa: float,
        home: Path,
        work: Path,
        *,
        optimise: str = "-O3 -march=native",
    ) -> None:
        self.inner, self.kappa = inner, kappa
        self.data, self.stages = inner.data, inner.stages
        self.reset = inner.reset
        p = self.problem = Problem(inner)
        self.exported = of(inner.model, "zero_order")
        x, place = ca.MX.sym("x", p.nx), ca.DM(np.ravel(planes))
        self.limits = ca.Function("zero_order_limits", [x], [p.limits(x, place)])
        self.slopes = limit_slopes(self.exported, self.limits)
        self.acados = acados_solver(
            p, home, work, "SQP_RTI", tolerance=1e-6, limited_end=True, optimise=optimise
        )
        self.N = p.n

    def get(self, stage: int, field: str) -> FloatArray:
        """Of the plan, without the command before."""
        found = np.asarray(self.acados.get(stage, field), dtype=float)
        return found[: self.problem.nx] if field == "x" else found

    def solve(self) -> Outcome:
        """A plan from that in `data`; status 0: solved, 2: not."""
        began, d, n = time.perf_counter(), self.data, self.N
        before = np.vstack([d["u_before"], d["u"]])
        for k in range(n + 1):
            j = min(k, n - 1)
            self.acados.set(k, "x", np.concatenate([d["x"][k], before[k]]))
            stage = (d["ref"][j], d["plane"][k].ravel(), d["x_end"])
            self.acados.set(k, "p", np.concatenate(stage))
            if k < n:
                self.acados.set(k, "u", d["u"][k])
        start = np.concatenate([d["x0"], d["u_before"]])
        for side in ("lbx", "ubx"):
            self.acados.constraints_set(0, side, start)
        status, off = robust_solve(
            _Plain(self),
            self.exported,
            self.limits,
            np.zeros(self.problem.nl),
            kappa=self.kappa,
            covariance=self.stages.estimate,
            gain=self.stages.gain,
            rounds=2,
            off=d["backoff"],
            slopes=self.slopes,
        )
        good = status in (0, MAX_ITERATIONS)
        if good:
            d["x"][:] = [self.get(k, "x") for k in range(n + 1)]
            d["u"][:] = [self.get(k, "u") for k in range(n)]
            d["backoff"][:] = off
        return Outcome(
            status=0 if good and np.isfinite(d["u"]).all() else 2,
            cost=float("nan"),
            kkt=float("inf"),
            step=float("nan"),
            iterations=2,
            qp_iterations=0,
            qp_status=0 if good else status,
            qp_residual=0.0,
            missed=0.0,
            clipped=0.0,
            seconds=time.perf_counter() - began,
            seconds_linear=0.0,
            seconds_tube=0.0,
            seconds_qp=0.0,
        )


class _Plain:
    """The acados solver of a `ZeroOrder` as `robust_solve` takes it."""

    def __init__(self, own: ZeroOrder) -> None:
        self.N, self.get = own.N, own.get
        self.constraints_set, self.solve = own.acados.constraints_set, own.acados.solve
