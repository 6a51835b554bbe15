"""The same optimal control problem handed to IPOPT: the reference that the controller's own solver
is held against.

Direct multiple shooting in raw coordinates with the same step, slack variables with the same exact
penalty, back-offs either fixed ("zero-order") or part of the problem ("full": the covariance
recursion is differentiated through).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import casadi as ca
import numpy as np

from greybox.errors import GreyboxError
from greybox.symbolic import Expr, FloatArray
from mpc_export.tube.solver import TubeSolver

Setting = bool | int | float | str
"""Value of an option of IPOPT or CasADi."""


@dataclass(frozen=True, kw_only=True)
class Solution:
    """x (N + 1, n_x), u (N, n_u), slack (N, planes + 1), cost with penalties, IPOPT's status and
    seconds of the solution."""

    x: FloatArray
    u: FloatArray
    slack: FloatArray
    cost: float
    status: str
    seconds: float


class IpoptSolver:
    """Built once from a `TubeSolver`, whose data every call reads: state, references, planes,
    back-offs, start.

    backoff: "fixed" takes the back-offs that stand in the data, "full" lets them depend on the
    plan. Raises `GreyboxError` where IPOPT does not converge.
    """

    def __init__(
        self,
        solver: TubeSolver,
        *,
        backoff: Literal["fixed", "full"] = "fixed",
        options: Mapping[str, Setting] | None = None,
    ) -> None:
        self.solver, self.full = solver, backoff == "full"
        s = self.size = solver.sizes
        n, nx, nu, nl = s["N"], s["NX"], s["NU"], s["NPL"] + 1
        f = solver.stages.functions
        x = [ca.MX.sym(f"x{k}", nx) for k in range(n + 1)]
        u = [ca.MX.sym(f"u{k}", nu) for k in range(n)]
        slack = [ca.MX.sym(f"s{k}", nl) for k in range(1, n + 1)]
        given = {
            name: ca.MX.sym(name, *reversed(solver.data[name].shape[:2] or (1, 1)))
            for name in ("ref", "backoff", "backoff_u", "wider")
        }
        given["plane"] = ca.MX.sym("plane", 4, s["NPL"] * (n + 1))
        given["bent"] = ca.MX.sym("bent", s["ND"] ** 2, n + 1)
        for name in ("x0", "u_before", "p", "x_end", "kappa", "Z0"):
            given[name] = ca.MX.sym(name, solver.data[name].size)
        scalars = {name: ca.MX.sym(name) for name in ("kappa_u", "penalty", "penalty_square")}
        p = given["p"][: s["NP"]]
        cost: Expr = 0.0
        g, low, high = [x[0] - given["x0"]], [np.zeros(nx)], [np.zeros(nx)]
        tight, tight_u = self._tightening(given, scalars, x, u, p)
        for k in range(n):
            before = u[k - 1] if k else given["u_before"]
            cost += f["tube_cost"](x[k], u[k], before, given["ref"][:, k])[0]
            g += [x[k + 1] - f["tube_linear"](x[k], u[k], p)[0], u[k] - before]
            low += [np.zeros(nx), -solver.data["rate_max"]]
            high += [np.zeros(nx), solver.data["rate_max"]]
            if k:
                g += [u[k] - tight_u[k], u[k] + tight_u[k]]
                low += [solver.data["u_min"].copy(), np.full(nu, -np.inf)]
                high += [np.full(nu, np.inf), solver.data["u_max"].copy()]
        cost += f["tube_end"](x[n], given["x_end"])[0]
        for k in range(1, n + 1):
            planes = given["plane"][:, s["NPL"] * k : s["NPL"] * (k + 1)]
            values = f["tube_limits"](x[k], planes)[0]
            g.append(values + tight[k] - slack[k - 1])
            low.append(np.full(nl, -np.inf))
            high.append(np.zeros(nl))
            cost += scalars["penalty"] * ca.sum1(slack[k - 1])
            cost += 0.5 * scalars["penalty_square"] * ca.sumsqr(slack[k - 1])
        self._order = (*given, *scalars)
        parameters = ca.vertcat(*(ca.vec(v) for v in (*given.values(), *scalars.values())))
        variables = ca.vertcat(*x, *u, *slack)
        problem = {"x": variables, "f": cost, "g": ca.vertcat(*g), "p": parameters}
        settings: dict[str, Setting] = {
            "ipopt.print_level": 0,
            "print_time": False,
            "ipopt.tol": 1e-9,
            "ipopt.sb": "yes",
            "error_on_fail": False,
        }
        self._solve = ca.nlpsol("reference", "ipopt", problem, {**settings, **(options or {})})
        self._bounds = np.concatenate(low), np.concatenate(high)

    def _tightening(
        self,
        given: dict[str, Expr],
        scalars: dict[str, Expr],
        x: list[Expr],
        u: list[Expr],
        p: Expr,
    ) -> tuple[list[Expr], list[Expr]]:
        s, f = self.size, self.solver.stages.functions
        n = s["N"]
        if not self.full:
            return [given["backoff"][:, k] for k in range(n + 1)], [
                given["backoff_u"][:, k] for k in range(n)
            ]
        keep, gain = list(self.solver.stages.keep), ca.DM(self.solver.stages.gain)
        z: Expr = ca.reshape(given["Z0"], s["ND"], s["ND"])
        c, b = ca.MX(s["ND"], s["NGP"]), ca.MX(s["ND"], s["NTH"])
        tight, tight_u, first = [], [], None
        for k in range(n + 1):
            total, z, c, b = f["tube_spread"](x[k], u[min(k, n - 1)], p, z, c, b)
            total += ca.reshape(given["bent"][:, k], s["ND"], s["ND"])
            first = total if first is None else first
            slope = f["tube_limits"](x[k], given["plane"][:, s["NPL"] * k : s["NPL"] * (k + 1)])[1]
            spread = ca.diag(slope @ total[keep, keep] @ slope.T)
            # a plane that is not there has no slope, and the root none at zero
            tight.append(given["kappa"] * given["wider"][:, k] * ca.sqrt(spread + 1e-18))
            tight_u.append(
                scalars["kappa_u"]
                * ca.sqrt(ca.fmax(ca.diag(gain @ (total - first) @ gain.T), 0) + 1e-18)
            )
        return tight, tight_u

    def solve(self) -> Solution:
        """Solve the problem that stands in the solver's data, from the plan that stands there."""
        data, s = self.solver.data, self.size
        n, nx, nu, nl = s["N"], s["NX"], s["NU"], s["NPL"] + 1
        values = np.concatenate([np.ravel(data[name]) for name in self._order])
        start = np.concatenate([data["x"].ravel(), data["u"].ravel(), np.zeros(n * nl)])
        lower = np.concatenate(
            [np.full((n + 1) * nx, -np.inf), np.tile(data["u_min"], n), np.zeros(n * nl)]
        )
        upper = np.concatenate(
            [np.full((n + 1) * nx, np.inf), np.tile(data["u_max"], n), np.full(n * nl, np.inf)]
        )
        found = self._solve(
            x0=start, p=values, lbx=lower, ubx=upper, lbg=self._bounds[0], ubg=self._bounds[1]
        )
        stats = self._solve.stats()
        if not stats["success"]:
            raise GreyboxError(
                "IPOPT did not solve the reference problem", got=stats["return_status"]
            )
        v = found["x"].full().ravel()
        at = (n + 1) * nx
        return Solution(
            x=v[:at].reshape(n + 1, nx),
            u=v[at : at + n * nu].reshape(n, nu),
            slack=v[at + n * nu :].reshape(n, nl),
            cost=float(found["f"]),
            status=stats["return_status"],
            seconds=float(stats.get("t_wall_total", np.nan)),
        )
