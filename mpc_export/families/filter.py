"""filter_step, follow_step and innovation_gain: one step of the filter, whatever is missing.

An innovation is formed from measured channels, and several may need the same one: of a position in
body axes each needs x, y and z. Where one of such innovations is missing, a channel is, and so are
all that need it.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from greybox.model.identified import IdentifiedModel
from greybox.symbolic import Expr
from mpc_export.adaptation import authority, limited
from mpc_export.dense import cholesky_solution
from mpc_export.model_parts import ModelParts
from mpc_export.noise import Noise
from mpc_export.predictors import PredictorModel
from mpc_export.standing import PREFIX


def add_filter(parts: ModelParts, noise: Noise, flying: Noise | None) -> None:
    """The stationary filter with the gain of what is there; with `flying` also follow_step, the one
    of standing.py, whose disturbances stay."""
    ne = len(parts.sampled.dynamics.innovations)
    fill = _filled_innovation(noise, "fill_innovation")
    mt = ca.MX.sym("there", ne)
    whole = parts.whole(mt)
    on = ca.if_else(whole != 0, 1.0, 0.0)
    gain = ca.MX(ca.DM(noise.gain)) @ ca.horzcat(
        *(fill(ca.DM.eye(ne)[:, i], whole) for i in range(ne))
    )
    spread = ca.DM(noise.innovation) * (on @ on.T) + ca.diag(1 - on)
    parts.functions["innovation_gain"] = ca.Function(
        "innovation_gain", [mt], [ca.densify(gain), ca.densify(spread)], ["there"], ["K", "S"]
    )
    _add_step(parts, "filter_step", noise, fill)
    if flying is not None:
        _add_step(parts, "follow_step", flying, _filled_innovation(flying, "fill_following"), True)


def _add_step(
    parts: ModelParts, name: str, noise: Noise, fill: ca.Function, stays: bool = False
) -> None:
    """One step of the filter of these numbers; stays: its disturbances do not decay."""
    s = parts.sampled
    mx, mu, mp = parts.arguments()
    my = ca.MX.sym("y", len(s.dynamics.outputs))
    mt = ca.MX.sym("there", len(s.dynamics.innovations))
    whole = parts.counted(mt, my)
    seen = parts.functions["h"](mx, mu, mp)
    found = parts.innovation(my, seen, mx)
    if isinstance(parts.model, PredictorModel):
        # What was foretold of the innovation and what was not enter together, as in the predictor
        # itself.
        push = fill(found, whole)
        if parts.posterior is not None:
            push = push + parts.push(mx, mu, mp, "raw")
        step = s.step(parts.x, parts.u, parts.p, parts.w)
        moved = ca.Function(
            "innovate", [parts.x, parts.u, parts.p, parts.w], [ca.cse(ca.densify(step))]
        )
        after = moved(mx, mu, parts.own_p(mp), push)
    else:
        correction = ca.mtimes(ca.DM(noise.gain), fill(found, whole))
        foretold: Expr = parts.functions["f_d"](mx, mu, mp)
        if stays:
            kept = [i for i, n in enumerate(s.states.names) if n.startswith(PREFIX)]
            foretold[kept] = mx[kept]
        after = parts.functions["boxplus"](foretold, correction)
        if stays and isinstance(parts.model, IdentifiedModel):
            after = limited(after, authority(parts.model), s.states)
    labels = ["x", "u", "p", "y", "there"]
    parts.functions[name] = ca.Function(
        name, [mx, mu, mp, my, mt], [after, found, seen], labels, ["x_next", "e", "y_hat"]
    )


def _filled_innovation(noise: Noise, name: str) -> ca.Function:
    """(e, there) -> e with what is missing replaced by its expectation given the others."""
    ne = len(noise.innovation)
    # With W = S^-1 it is e_gone = -W_gone,gone^-1 W_gone,there e_there, and the stationary gain
    # applies to the whole: K of a pattern is K times this map. Numbers are scaled to a unit
    # diagonal of W, which single precision needs.
    inverse = np.linalg.inv(noise.innovation)
    size = 1 / np.sqrt(np.diag(inverse))
    weight = ca.DM(inverse * np.outer(size, size))
    there, e = ca.SX.sym("there", ne), ca.SX.sym("e", ne)
    gone = ca.if_else(there != 0, 0.0, 1.0)
    known = ca.vertcat(*(ca.if_else(there[i] != 0, e[i] / size[i], 0.0) for i in range(ne)))
    both = weight * (gone @ gone.T - ca.diag(gone)) + ca.SX.eye(ne)
    expected = cholesky_solution(ne)(both, gone * (weight @ known))
    filled = (known - gone * expected) * size
    return ca.Function(name, [e, there], [ca.cse(ca.densify(filled))])
