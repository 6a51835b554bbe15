"""Outputs along a plan, how unsure the model is of them, and their slopes, as one CasADi function.

    Z+ = (A + B K) Z (A + B K)' + W,                  Z_0 = 0,   W = L S L' + U
    e+ = (A - L C) e + d - L h,                       e_0 = (1 - A + L C)^-1 (d - L h)
    t+ = (A + B K) t + L (C e + h),                   t_0 = 0
    cov(y) = C (P_f + Z) C' + (C (e + t) + h) D (C (e + t) + h)'

The tube of mpc_export/tube/stages.py, of outputs: P_f is the covariance of the filter, whose
innovations (gain L, covariance S) move the estimate by W, noise U that the model states ahead
included, and K feeds the estimate back. Errors that last, of the
parameters (slopes d of the step and h of the output, covariance D) and of the learned function (d =
B_d sd_g, h = 0, D = 1), are consider states (Schmidt 1966): e is what they have made of the estimate,
t what the controller has made of that. Of a predictor in innovation form cov(y) is that of the next
measurement, as it is exported (`output_covariance`, `output_consider`).
"""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca
import numpy as np

from greybox.symbolic import FloatArray
from mpc_export.functions import ModelFunctions


def output_stages(f: ModelFunctions, horizon: int, gain: FloatArray) -> ca.Function:
    """(x, U (n_u, N), p, P_f (n_d, n_d)) -> y (n_y, N), its variance, and A, B, C, D of all stages
    side by side.

    Parameters whose slope in y counts must be in p (`runtime_parameters`). C and D belong to y -
    y_hat as the filter forms it, for plain outputs the slope of y itself.
    """
    sizes = f.sizes
    x, p = ca.MX.sym("x", sizes["n_x"]), ca.MX.sym("p", sizes["n_p"])
    plan = ca.MX.sym("U", sizes["n_u"], horizon)
    estimate = ca.MX.sym("P", sizes["n_d"], sizes["n_d"])
    predictor = "output_covariance" in f.functions
    tube = _Innovations(f, gain) if predictor else _Filtered(f, gain, estimate)
    now = x
    found: list[list[ca.MX]] = [[] for _ in range(6)]
    for k in range(horizon):
        u = plan[:, k]
        after, a, b, _ = f["f_d_jac"](now, u, p)
        y, c, d, direct = f["h_jac"](now, u, p)
        variance = tube.next(now, u, p, (a, b, c, direct))
        for values, value in zip(found, (y, variance, a, b, c, d), strict=True):
            values.append(value)
        now = after
    results = [ca.densify(ca.horzcat(*values)) for values in found]
    return ca.Function("output_stages", [x, plan, p, estimate], results)


class _Innovations:
    """Of a predictor in innovation form; the learned error is carried by the exported functions."""

    def __init__(self, f: ModelFunctions, gain: FloatArray) -> None:
        self.f, self.gain = f, ca.DM(gain)
        n_d = f.sizes["n_d"]
        self.spread, self.common = ca.MX(n_d, n_d), ca.MX(n_d, f.sizes["n_g"])

    def next(self, x: ca.MX, u: ca.MX, p: ca.MX, _slopes: object) -> ca.MX:
        """Variance (n_y,) of y at this stage; goes on to the next."""
        learned = self.common.size2() > 0
        known: Mapping[str, ca.MX] = {"x": x, "u": u, "p": p, "S": self.spread} | (
            {"c": self.common} if learned else {}
        )
        seen = self.f["output_consider" if learned else "output_covariance"].call(known)["Y"]
        step = self.f["consider_step"].call(dict(known) | {"K": self.gain})
        self.spread, self.common = step["S_next"], step.get("c_next", self.common)
        return ca.diag(seen)


class _Filtered:
    """Of a model with a filter."""

    def __init__(self, f: ModelFunctions, gain: FloatArray, estimate: ca.MX) -> None:
        self.estimate = estimate
        self.f, self.gain, self.filter = f, ca.DM(gain), ca.DM(f.noise.gain)
        self.n_d, n_t = f.sizes["n_d"], f.sizes["n_theta"]
        n_g = f.sizes["n_g"]
        at = f.reference[0], f.reference[1], f.parameter_values
        a, c = f["f_d_jac"](*at)[1].full(), f["h_jac"](*at)[1].full()
        noise = f.noise
        self.fresh = ca.DM(noise.gain @ noise.innovation @ noise.gain.T + noise.unfiltered)
        self.lasting = ca.DM(np.linalg.inv(np.eye(self.n_d) - a + f.noise.gain @ c))
        self.size = ca.diagcat(ca.DM(f.covariance).reshape((n_t, n_t)), ca.DM.eye(n_g))
        self.spread = ca.MX(self.n_d, self.n_d)
        self.wrong: ca.MX | None = None
        self.told = ca.MX(self.n_d, n_t + n_g)

    def next(
        self, x: ca.MX, u: ca.MX, p: ca.MX, slopes: tuple[ca.MX, ca.MX, ca.MX, ca.MX]
    ) -> ca.MX:
        """Variance (n_y,) of y at this stage; goes on to the next."""
        a, b, c, direct = slopes
        closed = a + b @ self.gain
        push, shown = self._lasting(x, u, p, direct)
        if self.wrong is None:
            self.wrong = self.lasting @ (push - self.filter @ shown)
        off = c @ (self.wrong + self.told) + shown
        seen = c @ (self.estimate + self.spread) @ c.T + off @ self.size @ off.T
        self.told = closed @ self.told + self.filter @ (c @ self.wrong + shown)
        self.wrong = (a - self.filter @ c) @ self.wrong + push - self.filter @ shown
        self.spread = closed @ self.spread @ closed.T + self.fresh
        return ca.diag(seen)

    def _lasting(self, x: ca.MX, u: ca.MX, p: ca.MX, direct: ca.MX) -> tuple[ca.MX, ca.MX]:
        """What one unit of every lasting error moves the next state (n_d, n_t + n_g) and the output
        (n_y, n_t + n_g) by."""
        f, n_g = self.f, self.f.sizes["n_g"]
        columns = [
            direct[:, f.parameters[n]] if n in f.parameters else ca.MX(direct.size1(), 1)
            for n in f.covariance_names
        ]
        push = f["P_theta"](x, u, p) if columns else ca.MX(self.n_d, 0)
        if n_g:
            z = f["gp_features_raw"](x, u, p)[0]
            deviation = ca.sqrt(ca.fmax(f["gp_variance"](z, p), 0.0))
            push = ca.horzcat(push, f["B_d"](x, u, p) * ca.repmat(deviation.T, self.n_d, 1))
        return push, ca.horzcat(*columns, ca.MX(direct.size1(), n_g))
