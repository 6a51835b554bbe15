"""h and its Jacobians: what is measured, and how the filter compares it."""

from __future__ import annotations

import casadi as ca

from greybox.symbolic import Expr
from mpc_export.model_parts import ModelParts


def add_measurement(parts: ModelParts) -> Expr:
    """h and its Jacobians. Returns the slope of y - y_hat in w (n_e, n_w), as the filter forms
    it."""
    s, x, u, p, w = parts.sampled, parts.x, parts.u, parts.p, parts.w
    y_hat = s.output(x, u, p, w)
    parts.add_value("h", "y", y_hat)
    raw = tuple(ca.jacobian(y_hat, v) for v in (x, u, p, w))
    parts.add_jacobians("h_jac_raw", ("y", "C_raw", "D_raw", "H_raw"), y_hat, raw, "raw")
    y = ca.SX.sym("y", y_hat.numel())
    e = s.innovation(y, y_hat, x)
    slopes = [-ca.jacobian(e, v) for v in (x, u, p, w)]
    slopes[0] = slopes[0] @ parts.chart_in
    error = tuple(ca.substitute(slopes, [y], [y_hat]))
    parts.add_jacobians("h_jac", ("y", "C", "D", "H"), y_hat, error, "error")
    return error[3]
