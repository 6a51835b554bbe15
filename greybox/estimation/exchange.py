"""Exchange: what a motor's lag and a delay of the commands explain can be the other's.

Flights tell their sum (see `greybox.model.effective_lag`) far better than the two. Between "nearly
all lag" and "nearly all delay" lies a low ridge, which no descent crosses, with errors of one side
alone on both. So the other side is asked: one evaluation with the two exchanged, and the decrease
that a full Gauss-Newton step promises from there.
"""

from __future__ import annotations

from greybox.estimation.laplace import at_bound
from greybox.estimation.problem import Problem
from greybox.estimation.solvers.levenberg_marquardt import newton_decrement
from greybox.symbolic import FloatArray

PAIR = ("motor_lag.tau", "command_delay.d")
"""Lag and delay [s] in a row."""
CLEAR = 1.0
"""Log likelihood below which two optima are as likely."""


def exchanged(problem: Problem, theta: FloatArray) -> FloatArray | None:
    """The unknowns (n,) with lag and delay exchanged, from where a search may end below the optimum
    `theta` (n,); None where the two are not both free and shared, or nothing lower is promised."""
    places = [problem.index.get((name, None)) for name in PAIR]
    if None in places:
        return None
    pair = [i for i in places if i is not None]
    other = theta.copy()
    other[pair] = theta[pair[::-1]]
    other = problem.inside(other)
    here, there = problem.evaluate(theta, 0), problem.evaluate(other)
    if not there.valid or there.gradient is None or there.hessian is None:
        return None
    held = at_bound(problem, other, there)
    promised = newton_decrement(there.gradient, there.hessian, held)
    return other if there.cost - promised < here.cost - CLEAR else None
