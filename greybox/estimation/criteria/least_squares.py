"""Weighted least squares with fixed weights: cost = 1/2 sum (e_i / sigma_i)^2, no log det.

The weights are the sensors' standard deviations; where they are right this is the likelihood up to
a constant and the Hessian is the Fisher information (Ljung 1999, System Identification, sec. 7.2;
Maine and Iliff 1985, NASA RP-1138).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from greybox.errors import ModelError, UnknownNameError
from greybox.estimation.criteria.gaussian import LOG_2PI, Gaussian, weighted
from greybox.estimation.predictor import Block
from greybox.estimation.solver import Value

if TYPE_CHECKING:
    from greybox.estimation.problem import Problem


@dataclass(frozen=True, kw_only=True)
class LeastSquares:
    """Fixed weights 1 / sigma^2. `sigma` maps innovation names to standard deviations in the
    channel's unit.

    Channels that are not named keep the level that the problem starts with (vehicle file,
    `noise=`). A predictor's own covariance is ignored: noise levels among the unknowns then act
    only through the gain.
    """

    sigma: Mapping[str, float] = field(default_factory=dict)
    name: str = "least-squares"

    def evaluate(
        self, problem: Problem, blocks: Iterable[Block], order: int, scores: int | None
    ) -> Value:
        """Sum over all records. Raises `UnknownNameError`, `ModelError` for weights that do not
        fit."""
        names = problem.dynamics.innovations.names
        levels = problem.sensor_level.copy()
        for n, s in self.sigma.items():
            if n not in names:
                raise UnknownNameError("innovation", n, names)
            if not s > 0:
                raise ModelError(f"the weight's sigma of {n} must be positive", got=f"{s:g}")
            levels[names.index(n)] = s
        fixed = []
        constant = 0.0
        for b in blocks:
            if b.variance is not None:
                raise ModelError(
                    f"predictor {problem.predictor.name} weighs its residuals itself",
                    fix="use the Gaussian criterion",
                )
            fixed.append(weighted(replace(b, covariance_slope=None), levels**2))
            constant += float((b.mask * (np.log(levels) + 0.5 * LOG_2PI)).sum())
        value = Gaussian().evaluate(problem, fixed, order, scores)
        return replace(value, cost=value.cost - constant, likelihood=value.cost - constant)
