"""RateController: model predictive control of body rates on any exported predictor of them.

`OutputController` with the rates as outputs, one limit for all of them, and the mean of the
commands drawn to what the outer loops ask for: w_c (mean u_k - c).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from greybox.errors import ModelError
from greybox.symbolic import FloatArray
from mpc_export.functions import model_functions
from mpc_export.outputs.controller import OutputController, OutputProblem
from mpc_export.predictors import PredictorModel

GIVEN = ("phi[t-1]", "theta[t-1]")
FORM = "one slack per rate and stage"
"""Of the programme: flights that were flown with another form do not count with those of this
one."""


@dataclass(frozen=True, kw_only=True)
class RateProblem:
    """Horizon and weights: `limit` [rad/s], `collective` and `change` [rad/s per unit of command],
    `penalty` per rad/s beyond a limit at any stage."""

    limit: float
    horizon: int = 15
    collective: float = 10.0
    change: float = 6.0
    penalty: float = 50.0
    u_min: float = 0.05
    u_max: float = 0.95

    def __post_init__(self) -> None:
        if not (math.isfinite(self.limit) and self.limit > 0):
            raise ModelError("rate controller: the limit must be positive")
        if not (math.isfinite(self.collective) and self.collective >= 0):
            raise ModelError("rate controller: weights must be finite and not negative")
        self.of(1, 1)

    def of(self, n_y: int, n_u: int) -> OutputProblem:
        """The same for so many rates and commands. Raises `ModelError`."""
        limit = np.full(n_y, self.limit)
        return OutputProblem(
            weights=np.ones(n_y),
            lower=-limit,
            upper=limit,
            change=np.full(n_u, self.change),
            u_min=np.full(n_u, self.u_min),
            u_max=np.full(n_u, self.u_max),
            horizon=self.horizon,
            penalty=self.penalty,
            drawn=np.full((1, n_u), self.collective / n_u),
        )


class RateController(OutputController):
    """Commands from rates, sample by sample; `kappa` standard deviations are kept from the limits.

    Raises `ModelError` for a predictor that looks at measurements other than roll and pitch,
    `BuildError` without a compiler.
    """

    def __init__(self, model: PredictorModel, problem: RateProblem, *, kappa: float = 0.0) -> None:
        f = model_functions(model, with_=("covariance", "filter"))
        strange = [n for n in f.parameters.names if n not in GIVEN]
        if strange:
            raise ModelError(
                "the rate controller measures roll, pitch and rates",
                got=", ".join(strange),
                expected=", ".join(GIVEN),
                fix="learn with features that it has",
            )
        self._place = [GIVEN.index(n) for n in f.parameters.names]
        self.problem = problem
        super().__init__(f, problem.of(len(f.outputs), len(f.inputs)), kappa=kappa)

    def start(self, u: FloatArray | None = None) -> None:
        """As `OutputController`, level."""
        super().start(u)
        self.p = np.zeros(len(self._place))

    def sample(
        self, y: FloatArray, attitude: tuple[float, float], rates: FloatArray, collective: float
    ) -> FloatArray:
        """The command (n_u,) from the next sample on: y (n_y,) was measured under the present one;
        roll and pitch [rad] belong to it; asked are rates (n_y,) [rad/s] and the mean of the
        commands. What is not finite was not measured."""
        angles = np.array(attitude)[self._place]
        goal = np.array([self.problem.collective * collective])
        return self.answer(y, rates, goal, np.where(np.isfinite(angles), angles, self.p))
