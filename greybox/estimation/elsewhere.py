"""Elsewhere: where else the lag of the motors and the delay of the commands may be likelier.

Flights tell their sum (see `greybox.model.effective_lag`) far better than the two. Between "nearly
all lag" and "nearly all delay" lies a low ridge, and calm flights have a second optimum of the sum
itself, where gusts and inertia stand in for the rest: no descent leaves either. So other places are
asked: the two exchanged, as they started (what the user gave), and as they are expected. Each costs
a few evaluations; the decrease that a full Gauss-Newton step promises decides, once a step is seen
to keep what it promises.
"""

from __future__ import annotations

import numpy as np

from greybox.estimation.laplace import at_bound
from greybox.estimation.problem import Problem
from greybox.estimation.solvers.levenberg_marquardt import POOR, full_step
from greybox.symbolic import FloatArray

PAIR = ("motor_lag.tau", "command_delay.d")
"""Lag and delay [s] in a row."""
CLEAR = 1.0
"""Log likelihood below which two optima are as likely."""


def elsewhere(problem: Problem, theta: FloatArray, kept: float = POOR) -> FloatArray | None:
    """The unknowns (n,) with lag and delay where the lowest cost is promised, from where a search
    may end below the optimum `theta` (n,); None where they are not free and shared, or nothing
    lower is promised. `kept`: part of its promise that a step must keep to be believed."""
    pair = [i for name in PAIR if (i := problem.index.get((name, None))) is not None]
    unknowns = [problem.unknowns[i] for i in pair]
    ways = [[u.start for u in unknowns], [u.mean for u in unknowns]]
    if len(pair) == len(PAIR):
        ways.append(theta[pair[::-1]].tolist())
    places = {tuple(way) for way in ways if way != theta[pair].tolist()}
    if not places:
        return None
    # What a search that ended early has left promises nothing elsewhere.
    limit, best = _reached(problem, theta, kept) - CLEAR, None
    for place in sorted(places):
        other = theta.copy()
        other[pair] = place
        other = problem.inside(other)
        reached = _reached(problem, other, kept)
        if reached < limit:
            limit, best = reached, other
    return best


def _reached(problem: Problem, theta: FloatArray, kept: float) -> float:
    """The cost that a full step from `theta` (n,) promises, or reaches where less than `kept` of
    that is kept: far away the quadratic model means nothing. Infinite where there is no step."""
    there = problem.evaluate(theta)
    if not there.valid or there.gradient is None or there.hessian is None:
        return np.inf
    held = at_bound(problem, theta, there)
    step, promised = full_step(there.gradient, there.hessian, held)
    after = problem.evaluate(problem.inside(theta + step), 0)
    won = there.cost - after.cost if after.valid else 0.0
    return there.cost - (promised if won >= kept * promised else max(won, 0.0))
