"""out_of_domain: how far arguments lie beyond what was seen in training."""

from __future__ import annotations

import math

import casadi as ca

from greybox.estimation.engine import unfelt_place
from greybox.symbolic import Expr
from mpc_export.model_parts import ModelParts

NOWHERE = 1e30
"""Out-of-domain number of arguments that are NaN or absurd."""


def add_domain(parts: ModelParts) -> None:
    """number > 0 outside (NOWHERE for NaN): the larger of `box` (overshoot over the range seen in
    training, relative to it) and the learned part's distance over the 99 % quantile of its training
    inputs, minus one."""
    box, posterior = _box(parts), parts.posterior
    x, u, p = parts.arguments()
    overshoot: Expr = box(x, u, p) if box is not None else ca.MX(0.0)
    far: Expr = ca.MX(0.0)
    number: Expr = overshoot
    if posterior is not None and parts.states_variance:
        far = parts.functions["gp_distance"](parts.features("raw")(x, u, p)[0], p)
        usual = posterior.domain.distance[2]
        number = ca.fmax(overshoot, far / (usual if usual > 0 else 1.0) - 1.0)
    # fmax drops NaN, and a state that is not a number is in no domain.
    sane = ca.sumsqr(ca.vertcat(x, u, parts.own_p(p))) < NOWHERE
    number = ca.if_else(sane, ca.fmax(number, 0.0), NOWHERE)
    values = [ca.densify(v) for v in (number, overshoot, far)]
    parts.functions["out_of_domain"] = ca.Function(
        "out_of_domain", [x, u, p], values, ["x", "u", "p"], ["number", "box", "distance"]
    )


def _box(parts: ModelParts) -> ca.Function | None:
    """Largest relative overshoot of commands and outputs over their training range.

    Quaternions are left out, and coordinates of the place that no motion depends on: physics
    that was learned in one corner of a room holds in the other.
    """
    s, domain = parts.sampled, parts.model.domain
    u, p = parts.u, parts.p
    signals = {n: u[i] for i, n in enumerate(s.inputs.names)}
    signals |= {n: p[s.parameters[n]] for n in s.exogenous}
    felt = any(n.startswith("position.") for n in s.states.names)
    free = {*(unfelt_place(s.dynamics) if felt else "xy"), "qw", "qx", "qy", "qz"}
    quiet = ca.DM.zeros(parts.w.numel())
    y = s.output(parts.x, u, p, quiet)
    signals |= {n: y[i] for i, n in enumerate(s.dynamics.outputs.names) if n not in free}
    terms = []
    for name, value in signals.items():
        low, high = domain.get(name, (-math.inf, math.inf))
        if math.isfinite(low) and math.isfinite(high) and high > low:
            terms.append(ca.fmax(low - value, value - high) / (high - low))
    if not terms:
        return None
    whole = ca.SX.sym("p", len(parts.parameters))
    worst = ca.fmax(ca.mmax(ca.vertcat(*terms)), 0.0)
    worst = ca.substitute(worst, p, whole[: p.numel()])
    return ca.Function("domain_box", [parts.x, u, whole], [ca.cse(ca.densify(worst))])
