"""f, f_d, their Jacobians in raw and error coordinates, and the chart between both."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from greybox.symbolic import Expr
from mpc_export.model_parts import ModelParts

RAW = ("x_next", "A_raw", "B_raw", "P_raw")


@dataclass(frozen=True, kw_only=True)
class PushSlopes:
    """Derivatives of x_next: `learned` in the learned outputs (n_d or n_x, n_g) by name, `noise` in
    w (n_d, n_w)."""

    learned: dict[str, Expr]
    noise: Expr


def add_motion(parts: ModelParts, *, nominal: bool) -> PushSlopes:
    """f, f_d and their Jacobians; with `nominal` also the step without the learned part."""
    s, x, u, p, w = parts.sampled, parts.x, parts.u, parts.p, parts.w
    if not parts.discrete:
        own = x[: len(s.dynamics.states)]
        dx = s.derivative(x, u, p, w)
        parts.add_value("f", "dx", dx, own=True)
        slopes = tuple(ca.jacobian(dx, v) for v in (own, u, p, w))
        parts.add_jacobians("f_jac_raw", ("dx", "dx_x", "dx_u", "dx_p"), dx, slopes, "own")
    after = s.step(x, u, p, w)
    parts.add_value("f_d", "x_next", after)
    raw = tuple(ca.jacobian(after, v) for v in (x, u, p, w))
    # One physics serves raw and error coordinates and the nominal step, so that the code holds it
    # once.
    physics = parts.physics("f_d", after, raw)
    parts.add_closed("f_d_jac_raw", RAW, physics, "raw")
    if nominal and parts.posterior is not None:
        _add_nominal(parts, physics)
    parts.add_closed(
        "f_d_jac",
        ("x_next", "A", "B", "P"),
        physics,
        "error",
        _to_error_coordinates(parts, physics),
    )
    _, out = s.chart(x, after)
    return PushSlopes(
        learned={"B_d": out @ raw[3] @ parts.spread, "B_d_raw": raw[3] @ parts.spread},
        noise=out @ raw[3],
    )


def _to_error_coordinates(parts: ModelParts, physics: ca.Function) -> ca.Function:
    """(x, x_next, slopes of the physics) -> the slopes between error coordinates."""
    after = ca.SX.sym("x_next", parts.x.numel())
    slopes = [ca.SX.sym("m", physics.sparsity_out(k)) for k in range(1, physics.n_out())]
    into, out = parts.sampled.chart(parts.x, after)
    turned = [out @ slopes[0] @ into, *(out @ v for v in slopes[1:])]
    return ca.Function(
        "to_error_coordinates", [parts.x, after, *slopes], [ca.sparsify(v) for v in turned]
    )


def _add_nominal(parts: ModelParts, physics: ca.Function) -> None:
    """The step of the physics alone and its raw Jacobians; the weights of a learned part in p
    change nothing."""
    x, u, p = parts.arguments()
    after, by_x, by_u, by_p = list(physics(x, u, parts.own_p(p), ca.DM.zeros(parts.w.numel())))[:4]
    values: list[Expr] = [
        after,
        by_x,
        by_u,
        ca.horzcat(by_p, ca.MX(x.numel(), p.numel() - parts.p.numel())),
    ]
    for name, n in (("f_d_nominal", 1), ("f_d_nominal_jac_raw", 4)):
        results = [ca.densify(v) for v in values[:n]]
        parts.functions[name] = ca.Function(
            name, [x, u, p], results, ["x", "u", "p"], list(RAW[:n])
        )


def add_charts(parts: ModelParts) -> None:
    """boxplus and boxminus, between raw and error coordinates."""
    s, x = parts.sampled, parts.x
    d, x2 = ca.SX.sym("d", len(s.error_states)), ca.SX.sym("x2", x.numel())
    moved, between = ca.densify(s.boxplus(x, d)), ca.densify(s.boxminus(x2, x))
    parts.functions["boxplus"] = ca.Function("boxplus", [x, d], [moved], ["x", "d"], ["x_moved"])
    parts.functions["boxminus"] = ca.Function("boxminus", [x2, x], [between], ["x2", "x1"], ["d"])
