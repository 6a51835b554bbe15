"""What the states of force and torque without a name are worth to a likelihood."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Protocol

import numpy as np

from greybox.estimation.problem import Problem, Value
from greybox.symbolic import FloatArray

SILENT = 12.0
"""By how much the logarithm of a level falls when its state is taken away."""
LOUDER = tuple(0.35 * i for i in range(11))
"""By how much the logarithm of the white noise is tried to rise in its place."""


class Solved(Protocol):
    """A problem, its unknowns (n,) and the value there."""

    @property
    def problem(self) -> Problem:
        """The problem."""
        ...

    @property
    def theta(self) -> FloatArray:
        """All its unknowns (n,)."""
        ...

    @property
    def value(self) -> Value:
        """Cost and likelihood there."""
        ...


@functools.lru_cache(maxsize=8)
def lost_without(at: Solved) -> Mapping[str, float]:
    """Axis of force and torque -> log likelihood lost when its state is taken away and white noise
    takes over what it can. All else stays, which overstates the loss. Asked of one fit again and
    again."""
    problem, theta = at.problem, at.theta
    place = {u.name: i for i, u in enumerate(problem.unknowns)}
    out: dict[str, float] = {}
    for name, i in place.items():
        axis = name.removeprefix("noise.process.disturbance.")
        if axis == name:
            continue
        white = place[f"noise.process.{axis}"]
        best = np.inf
        for louder in LOUDER:
            still = theta.copy()
            still[i] = max(problem.lower[i], theta[i] - SILENT)
            still[white] = min(max(theta[white], theta[i]) + louder, problem.upper[white])
            likelihood = problem.evaluate(still, 0).likelihood
            if likelihood > best:  # it has passed its minimum
                break
            best = likelihood
        out[axis] = float(best - at.value.likelihood)
    return out
