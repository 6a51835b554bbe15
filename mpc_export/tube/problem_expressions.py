"""The tube's problem as plain expressions, for solvers that bring their own derivatives."""

from __future__ import annotations

import casadi as ca
import numpy as np

from greybox.frames import rotation_matrix
from mpc_export.semidefinite import upper_half
from mpc_export.tube.solver import TubeSolver
from mpc_export.tube.stages import block


class Problem:
    """Of a `TubeSolver`: `residual(x, u, u_before, ref)` and `end(x, x_end)`, of which half the
    square is the cost of a stage and of the last state, and `limits(x, planes)`, which must not be
    positive. They are held against the solver's own stage functions."""

    def __init__(self, solver: TubeSolver) -> None:
        self.solver, self.model, self.task = solver, solver.model, solver.problem
        m, w, n = self.model, self.task.weights, solver.sizes
        self.n, self.nx, self.nu, self.npl, self.nl = (
            n["N"],
            n["NX"],
            n["NU"],
            n["NPL"],
            n["NPL"] + 1,
        )
        x, u, before = ca.MX.sym("x", self.nx), ca.MX.sym("u", self.nu), ca.MX.sym("v", self.nu)
        ref, goal, planes = (
            ca.MX.sym("ref", 7 + self.nu),
            ca.MX.sym("g", self.nx),
            ca.MX.sym("pl", 4 * self.npl),
        )
        turn, place = rotation_matrix(x[block(m, "attitude")]), x[block(m, "position")]
        heading = ca.cos(ref[6]) * turn[1, 0] - ca.sin(ref[6]) * turn[0, 0]
        r = ca.vertcat(
            w.position * (place - ref[:3]),
            w.velocity * (x[block(m, "velocity")] - ref[3:6]),
            w.yaw * heading,
            w.rate * x[block(m, "rate")],
            w.command * (u - ref[7:]),
            w.change * (u - before),
        )
        keep = list(solver.stages.keep)
        end = ca.DM(upper_half(solver.stages.terminal)) @ m["boxminus"](x, goal)[keep]
        rows = [
            ca.dot(planes[4 * j : 4 * j + 3], place) - planes[4 * j + 3] for j in range(self.npl)
        ]
        values = ca.vertcat(*rows, np.cos(self.task.tilt_max) - turn[2, 2])
        self.residual = ca.Function("r", [x, u, before, ref], [r])
        self.end = ca.Function("end", [x, goal], [end])
        self.limits = ca.Function("limits", [x, planes], [values])
        self.hover = solver.stages.steady[1]
        self._check()

    def _check(self) -> None:
        """Same numbers as the controller's own stage functions."""
        rng, f = np.random.default_rng(0), self.solver.stages.functions
        x = self.model["boxplus"](
            self.solver.stages.steady[0], 0.1 * rng.standard_normal(self.solver.sizes["ND"])
        )
        u, v, ref = rng.random(self.nu), rng.random(self.nu), rng.random(7 + self.nu)
        planes, goal = rng.random((4, self.npl)), self.solver.stages.steady[0]
        pairs = [
            (0.5 * ca.sumsqr(self.residual(x, u, v, ref)), f["tube_cost"](x, u, v, ref)[0]),
            (0.5 * ca.sumsqr(self.end(x, goal)), f["tube_end"](x, goal)[0]),
            (self.limits(x, planes.ravel(order="F")), f["tube_limits"](x, planes)[0]),
        ]
        for mine, theirs in pairs:
            np.testing.assert_allclose(np.asarray(mine), np.asarray(theirs), rtol=1e-9, atol=1e-12)
