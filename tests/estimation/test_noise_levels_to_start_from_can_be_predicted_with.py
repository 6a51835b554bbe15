"""Noise levels to start from come from a linear filter; where the prediction runs away with them
they are not taken."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from greybox.estimation.criteria.gaussian import Gaussian
from greybox.estimation.initialisation import noise_start
from greybox.estimation.predictors.innovation import Innovation
from greybox.estimation.problem import make_problem
from tests.discovery.toy import CORE, EVERY, NULL, model, record


class Fragile:
    """A problem whose prediction is finite for the first `good` questions only."""

    def __init__(self, problem: Any, good: int) -> None:
        self.problem, self.left = problem, good

    def __getattr__(self, name: str) -> Any:
        return getattr(self.problem, name)

    def evaluate(self, theta: Any, order: int = 0) -> Any:
        self.left -= 1
        return SimpleNamespace(valid=self.left >= 0)


def test_levels_that_let_the_prediction_run_away_are_not_taken() -> None:
    problem = make_problem(
        model(),
        record(1),
        predictor=Innovation(),
        criterion=Gaussian(),
        free=CORE,
        build=EVERY,
        values=NULL,
    )
    whole = noise_start(problem)
    first = noise_start(problem, rounds=1)
    assert not np.allclose(whole, first)
    np.testing.assert_array_equal(noise_start(Fragile(problem, 0)), problem.start)  # type: ignore[arg-type]
    np.testing.assert_array_equal(noise_start(Fragile(problem, 1)), first)  # type: ignore[arg-type]
    np.testing.assert_array_equal(noise_start(Fragile(problem, 2)), whole)  # type: ignore[arg-type]
