"""Varying: what a constant of the craft that differs from flight to flight does to the errors of
others.

A thrust scale has one value per flight where flights ask for it: a battery runs down, and nothing
measures it. It runs down within a flight, too. How it differs between flights is the only measure
of that, and what leans on the scale (inertia, drag torque) is not known better: beyond its own
errors, the scatter of the scale is carried into theirs, as that of a parameter which is held.
"""

from __future__ import annotations

import numpy as np

from greybox.estimation.covariance import scaled_inverse
from greybox.estimation.problem import Problem
from greybox.model.core_parameters import core_parameters
from greybox.model.layer import physics_of
from greybox.symbolic import BoolArray, FloatArray


def varying_spread(
    problem: Problem, theta: FloatArray, hessian: FloatArray, held: BoolArray
) -> FloatArray:
    """What constants of the vehicle with a value per flight add to the covariance (n, n) of the
    other unknowns, of a fit that ended at `theta` (n,) with this Hessian (n, n) and unknowns that
    are `held` (n,) at a bound."""
    out = np.zeros((problem.n, problem.n))
    physics = physics_of(problem.dynamics)
    constants = set() if physics is None else {d.name for d in core_parameters(physics.vehicle)}
    of: dict[str, list[int]] = {}
    for i, u in enumerate(problem.unknowns):
        if u.kind == "parameter" and u.flight and u.name in constants and not held[i]:
            of.setdefault(u.name, []).append(i)
    own = [i for places in of.values() if len(places) > 1 for i in places]
    others = [i for i in range(problem.n) if not held[i] and i not in own]
    if not own or not others:
        return out
    inverse, _ = scaled_inverse(hessian[np.ix_(others, others)])
    moves = -inverse @ hessian[np.ix_(others, own)]
    variance = np.diag(scaled_inverse(hessian[~held][:, ~held])[0])
    error = dict(zip(np.flatnonzero(~held).tolist(), variance.tolist(), strict=True))
    more = {
        n: max(float(theta[places].var(ddof=1)) - float(np.mean([error[i] for i in places])), 0.0)
        for n, places in of.items()
        if len(places) > 1
    }
    scatter = np.array([more[problem.unknowns[i].name] for i in own])
    out[np.ix_(others, others)] = (moves * scatter) @ moves.T
    return out
