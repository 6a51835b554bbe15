"""Uncertainty over a horizon: covariance_step, consider_step, P_theta, and that of the next
measurement."""

from __future__ import annotations

import casadi as ca

from greybox.model.linear import LinearModel
from greybox.symbolic import Expr
from mpc_export.model_parts import ModelParts
from mpc_export.noise import Noise
from mpc_export.predictors import PredictorModel


def add_covariance(parts: ModelParts, noise: Noise, noise_output: Expr) -> None:
    """Steps of the covariance; `noise_output` (n_e, n_w) is the slope of y - y_hat in w."""
    nd = len(parts.sampled.error_states)
    x, u, p = parts.arguments()
    sigma, gain = ca.MX.sym("S", nd, nd), ca.MX.sym("K", parts.u.numel(), nd)
    _, a, b, _ = parts.functions["f_d_jac"](x, u, p)
    closed = a + b @ gain
    learned = ca.DM.zeros(nd, nd)
    if parts.states_variance:
        spread = parts.functions["B_d"](x, u, p)
        learned = (spread * ca.repmat(parts.variance(x, u, p).T, nd, 1)) @ spread.T
    for name, arguments, labels, matrix in (
        ("covariance_step", [x, u, p, sigma], ["x", "u", "p", "S"], a),
        ("covariance_feedback", [x, u, p, sigma, gain], ["x", "u", "p", "S", "K"], closed),
    ):
        after = ca.densify(matrix @ sigma @ matrix.T + learned + ca.DM(noise.process))
        parts.functions[name] = ca.Function(name, arguments, [after], labels, ["S_next"])
    _add_consider_step(parts, noise)
    if isinstance(parts.model, (PredictorModel, LinearModel)):
        _add_output_covariance(parts, noise, noise_output)


def _add_consider_step(parts: ModelParts, noise: Noise) -> None:
    """Errors that stay the same over the whole horizon travel as columns of their own (Schmidt
    1966)."""
    nd = len(parts.sampled.error_states)
    x, u, p = parts.arguments()
    sigma, gain = ca.MX.sym("S", nd, nd), ca.MX.sym("K", parts.u.numel(), nd)
    _, a, b, _ = parts.functions["f_d_jac"](x, u, p)
    closed, total = a + b @ gain, sigma
    arguments, labels = [x, u, p, gain, sigma], ["x", "u", "p", "K", "S"]
    results, names = [closed @ sigma @ closed.T + ca.DM(noise.process)], ["S_next"]
    if parts.states_variance:
        spread = parts.functions["B_d"](x, u, p)
        deviation: Expr = ca.sqrt(parts.variance(x, u, p))
        c = ca.MX.sym("c", nd, spread.shape[1])
        arguments, labels = [*arguments, c], [*labels, "c"]
        total = total + c @ c.T
        results.append(closed @ c + spread * ca.repmat(deviation.T, nd, 1))
        names.append("c_next")
    if parts.theta_names:
        bias = ca.MX.sym("b", nd, len(parts.theta_names))
        arguments, labels = [*arguments, bias], [*labels, "b"]
        total = total + bias @ ca.DM(parts.theta_covariance) @ bias.T
        results.append(closed @ bias + _by_theta(parts)(x, u, p))
        names.append("b_next")
    results, names = [*results, total], [*names, "total"]
    parts.functions["consider_step"] = ca.Function(
        "consider_step", arguments, [ca.densify(v) for v in results], labels, names
    )


def _add_output_covariance(parts: ModelParts, noise: Noise, noise_output: Expr) -> None:
    """Of the next measurement, S and c being those of the state: C S C' + D_g Var D_g' + cov(e),
    and with the learned error as the same over the horizon (C c + D_g sigma)(...)' in place of
    the middle term. With S = 0 (and c = 0) it is the one-step variance."""
    nd = len(parts.sampled.error_states)
    x, u, p = parts.arguments()
    sigma = ca.MX.sym("S", nd, nd)
    c = parts.functions["h_jac"](x, u, p)[1]
    plain = c @ sigma @ c.T + ca.DM(noise.innovation)
    arguments, labels = [x, u, p, sigma], ["x", "u", "p", "S"]
    if not parts.states_variance:
        parts.functions["output_covariance"] = ca.Function(
            "output_covariance", arguments, [ca.densify(plain)], labels, ["Y"]
        )
        return
    slope = ca.densify(noise_output @ parts.spread)
    through = ca.Function("noise_output", [parts.x, parts.u, parts.p, parts.w], [slope])
    d = through(x, u, parts.own_p(p), ca.DM.zeros(parts.w.numel()))
    wide = ca.repmat(parts.variance(x, u, p).T, d.shape[0], 1)
    fresh = plain + (d * wide) @ d.T
    parts.functions["output_covariance"] = ca.Function(
        "output_covariance", arguments, [ca.densify(fresh)], labels, ["Y"]
    )
    bias = ca.MX.sym("c", nd, d.shape[1])
    now = c @ bias + d * ca.sqrt(wide)
    parts.functions["output_consider"] = ca.Function(
        "output_consider",
        [*arguments, bias],
        [ca.densify(plain + now @ now.T)],
        [*labels, "c"],
        ["Y"],
    )


def _by_theta(parts: ModelParts) -> ca.Function:
    """(x, u, p) -> derivative of x_next in the uncertain parameters, error coordinates (n_d,
    n_theta)."""
    s, theta = parts.sampled, ca.SX.sym("theta", len(parts.theta_names))
    after = s.step(parts.x, parts.u, parts.p, parts.w, theta)
    _, out = s.chart(parts.x, after)
    slope = ca.substitute(
        out @ ca.jacobian(after, theta), theta, s._baked(parts.p, parts.theta_names)
    )
    parts.add_value("P_theta", "P_theta", slope)
    return parts.functions["P_theta"]
