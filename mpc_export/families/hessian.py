"""lagrangian_hessian: second derivatives of a sample, for solvers that use them."""

from __future__ import annotations

import casadi as ca

from greybox.symbolic import Expr
from mpc_export.model_parts import ModelParts


def add_hessian(parts: ModelParts) -> None:
    """H of lam' f_d in (x, u), raw coordinates."""
    lam: Expr = ca.MX.sym("lam", parts.x.numel())
    x, u, p = parts.arguments()
    value: Expr
    if parts.posterior is None:
        lam = ca.SX.sym("lam", parts.x.numel())
        x, u, p = parts.x, parts.u, parts.p
        value = ca.dot(lam, parts.sampled.step(x, u, p, ca.DM.zeros(parts.w.numel())))
        hessian = ca.densify(ca.hessian(value, ca.vertcat(x, u))[0])
    else:
        v = ca.MX.sym("v", x.numel() + u.numel())
        value = ca.dot(lam, parts.functions["f_d"](v[: x.numel()], v[x.numel() :], p))
        inner = ca.Function("hessian_of_both", [v, p, lam], [ca.densify(ca.hessian(value, v)[0])])
        hessian = inner(ca.vertcat(x, u), p, lam)
    parts.functions["lagrangian_hessian"] = ca.Function(
        "lagrangian_hessian", [x, u, p, lam], [hessian], ["x", "u", "p", "lam"], ["H"]
    )
