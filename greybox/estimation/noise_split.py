"""Noise split: errors where flights do not tell a sensor's noise from what pushes white on it.

An accelerometer feels a white force as it feels its own noise. Without a position the sum alone is
told: the likelihood is flat from "all force" to "all sensor", and a search ends anywhere. What
integrates the reading, such as a bias beside a height, is told far better where the sensor is
exact. The Hessian at one end does not know the other, as the logarithm of a small level moves
nothing. So where the prior decides a sensor's level, other splits are asked, the one with all of the
sum in the sensor first: one evaluation each. From the first from which a full step comes as near as
chance, errors are the wider of the two.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from greybox.estimation.covariance import scaled_inverse
from greybox.estimation.predictors.innovation import Innovation
from greybox.estimation.problem import Problem
from greybox.estimation.solver import Value
from greybox.estimation.solvers.levenberg_marquardt import newton_decrement
from greybox.symbolic import BoolArray, FloatArray

DECIDES = 0.5
"""Share of a level's variance from which on its prior decides it."""
LEFT = (0.1, 0.5, 0.9)
"""Shares of a push that are left where the sensor takes the rest of the sum."""
CHANCE = 1.92
"""Log likelihood that two values of one number may differ by (95 %)."""
FELT = 1.1
"""Ratio of errors from which on something depends on the split."""


def wider_split(
    problem: Problem, theta: FloatArray, value: Value, fisher: FloatArray, held: BoolArray
) -> tuple[FloatArray, tuple[str, ...]]:
    """(by how much the errors of the unknowns (n,) at `theta` (n,) are wider at another split of
    noise levels, 1 where not; which splits, in words), from the `value` there and its inverse
    Hessian `fisher` (n, n); unknowns `held` (n,) have no error."""
    wider, said = np.ones(problem.n), []
    here, free = np.sqrt(np.diag(fisher)), ~held
    craft = np.array([u.kind == "parameter" for u in problem.unknowns]) & free
    for sensor, push, others in _other_splits(problem, theta, here):
        there = _as_likely(problem, others, value.cost + CHANCE, held)
        if there is None or there.hessian is None:
            continue
        inverse, _ = scaled_inverse(there.hessian[np.ix_(free, free)])
        ratio = np.ones(problem.n)
        ratio[free] = np.sqrt(np.diag(inverse)) / here[free]
        ratio = np.where(craft & np.isfinite(ratio), ratio, 1.0)
        wider = np.maximum(wider, ratio)
        moved = sorted({problem.unknowns[i].name for i in np.flatnonzero(ratio > FELT)})
        if moved:
            said.append(
                f"{sensor} and {push} are one number to these flights: errors of "
                f"{', '.join(moved)} are those of the split that tells them less; state the "
                "sensor's noise, or log a position"
            )
    return wider, tuple(said)


def _as_likely(
    problem: Problem, places: Sequence[FloatArray], limit: float, held: BoolArray
) -> Value | None:
    """The first of these unknowns (n,) from where a full step comes below the cost `limit`."""
    for place in places:
        there = problem.evaluate(place)
        if there.gradient is None or there.hessian is None:
            continue
        if there.cost - newton_decrement(there.gradient, there.hessian, held) < limit:
            return there
    return None


def _other_splits(
    problem: Problem, theta: FloatArray, error: FloatArray
) -> list[tuple[str, str, list[FloatArray]]]:
    """(level of a sensor that its prior decides, level of what pushes on it most, the unknowns (n,)
    where the sensor has more of their sum, the most first)."""
    names = problem.dynamics.innovations.names
    untold = []
    for row, name in enumerate(names):
        at = problem.place(f"noise.sensor.{name}")
        if at is not None and error[at] ** 2 > DECIDES * problem.unknowns[at].sigma ** 2:
            untold.append((row, at))
    if not untold:
        return []
    prepared = problem.prepared(Innovation())
    x, window = prepared.reference
    p = problem.parameters_of(theta, None)
    through = prepared.linearisation.values(x, window, p, problem.dt)[3]
    process, sensor = problem.noise_levels(theta)
    ends = []
    for row, at in untold:
        felt = np.abs(through[row]) * process
        column = int(np.argmax(felt))
        push = problem.place(f"noise.process.{problem.dynamics.noises.names[column]}")
        if push is None or not felt[column] > sensor[row]:
            continue
        others = []
        for left in LEFT:
            other = theta.copy()
            other[at] = np.log(np.hypot(sensor[row], felt[column] * np.sqrt(1 - left**2)))
            other[push] += np.log(left)
            others.append(np.clip(other, problem.lower, problem.upper))
        ends.append((problem.unknowns[at].name, problem.unknowns[push].name, others))
    return ends
