"""Ridge: what no slope tells, since a delay of the commands stands for it.

Next to a delay the lag is short, and of a lag so short nothing is felt of its second order, although
the delay is there for it: both say that rotors answer late at first. So it is asked for where it
would be: at the same sum of lag and delay, all of it lag or half the delay left, with the order that
is likeliest there, all else as fitted. That is a bound from below on what a fit with it would reach.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize_scalar

from greybox.data import Dataset
from greybox.estimation.elsewhere import PAIR
from greybox.estimation.engine import engine_for
from greybox.estimation.prior import Prior, unknown_of
from greybox.estimation.problem import Problem
from greybox.estimation.record import make_records
from greybox.estimation.result import Fit
from greybox.model.absence import absence
from greybox.model.effect import Effect
from greybox.model.layer import physics_of, with_physics
from greybox.statistics.rivals import Form
from greybox.symbolic import FloatArray

DELAY_LEFT = (0.0, 0.5)
"""Parts of the delay that are left beside the second order."""
CLOSE = 0.01
"""How closely the likeliest order is sought, in units of the bounds of its coefficient."""


def on_the_ridge(
    found: Fit,
    reached: float,
    data: Dataset,
    offered: Sequence[Effect],
    fitted: Sequence[int],
    price: float,
) -> list[Form]:
    """The form with the second order of the rotors' lag in the place of the delay of the commands,
    if it is likelier than the fit, whose cost is `reached`; `fitted` are the places of its unknowns
    among which the form says what moves, `price` the log of how many causes are asked for."""
    small = found.problem
    lag, late = (small.index.get((name, None)) for name in PAIR)
    second = [e for e in offered if "lag_second" in e.early]
    if not second or lag is None or late is None or not found.theta[late] > 0:
        return []
    wide = _with(small, second[0], data)
    places = [_likeliest(wide, found.theta, lag, late, left) for left in DELAY_LEFT]
    cost, there = min(places, key=lambda p: p[0])
    odds = reached - cost - price - 0.5 * float(np.log(sum(r.n for r in small.records)))
    if not odds > 0:
        return []
    row = {place: k for k, place in enumerate(fitted)}
    shift = np.zeros(len(fitted))
    for i in (lag, late):
        if i in row:
            shift[row[i]] = there[i] - found.theta[i]
    none = np.zeros((len(fitted), len(fitted)))
    return [Form(causes=(second[0].name,), log_odds=odds, shift=shift, more=none)]


def _likeliest(
    wide: Problem, theta: FloatArray, lag: int, late: int, left: float
) -> tuple[float, FloatArray]:
    """(lowest cost, unknowns there) over the coefficient of the second order, the last unknown,
    where `left` of the delay is left."""
    at = np.append(theta, wide.lower[-1])
    at[late] = left * theta[late]
    at[lag] = theta[lag] + theta[late] - at[late]
    at = np.clip(at, wide.lower, wide.upper)

    def cost(b: float) -> float:
        return wide.evaluate(np.append(at[:-1], b), 0).cost

    low, high = float(wide.lower[-1]), float(wide.upper[-1])
    best = minimize_scalar(
        cost, bounds=(low, high), method="bounded", options={"xatol": CLOSE * (high - low)}
    )
    return float(best.fun), np.append(at[:-1], float(best.x))


def _with(small: Problem, effect: Effect, data: Dataset) -> Problem:
    """The problem with one effect more, whose one parameter is the last unknown. It has no
    sensitivities; what only the larger model has starts where it is known."""
    physics = physics_of(small.dynamics)
    assert physics is not None
    large = with_physics(small.dynamics, lambda m: m.with_effect(effect))
    engine = engine_for(large, (), use_compiler=small.engine.compiled, sensitive=False)
    own = dict(zip((d.name for d in small.dynamics.parameters), small.base, strict=True))
    ((name, (null, sigma)),) = absence(effect, physics.vehicle).items()
    (d,) = (d for d in large.parameters if d.name == name)
    names = small.dynamics.error_states.names

    def spread(there: FloatArray) -> FloatArray:
        known = dict(zip(names, there, strict=True))
        return np.array([known.get(n, 0.0) for n in large.error_states.names])

    return replace(
        small,
        dynamics=large,
        engine=engine,
        records=make_records(engine, data),
        base=np.array([own.get(d.name, null) for d in large.parameters]),
        spreads=None if small.spreads is None else tuple(spread(s) for s in small.spreads),
        unknowns=(*small.unknowns, unknown_of(d, null, Prior(null, sigma))),
    )
