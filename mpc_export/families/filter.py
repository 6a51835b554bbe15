"""filter_step and innovation_gain: one step of the identified filter, whatever is missing.

An innovation is formed from measured channels, and several may need the same one: of a position in
body axes each needs x, y and z. Where one of such innovations is missing, a channel is, and so are
all that need it.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from mpc_export.dense import cholesky, cholesky_solve
from mpc_export.model_parts import ModelParts
from mpc_export.noise import Noise
from mpc_export.predictors import PredictorModel


def add_filter(parts: ModelParts, noise: Noise) -> None:
    """The stationary filter with the gain of what is there."""
    s = parts.sampled
    ne, ny = len(s.dynamics.innovations), len(s.dynamics.outputs)
    fill = _filled_innovation(noise)
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
    mx, mu, mp = parts.arguments()
    my = ca.MX.sym("y", ny)
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
        after = parts.functions["boxplus"](parts.functions["f_d"](mx, mu, mp), correction)
    labels = ["x", "u", "p", "y", "there"]
    parts.functions["filter_step"] = ca.Function(
        "filter_step", [mx, mu, mp, my, mt], [after, found, seen], labels, ["x_next", "e", "y_hat"]
    )


def _filled_innovation(noise: Noise) -> ca.Function:
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
    filled = (known - gone * cholesky_solve(cholesky(both), gone * (weight @ known))) * size
    return ca.Function("fill_innovation", [e, there], [ca.cse(ca.densify(filled))])
