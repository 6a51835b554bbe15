"""Criterion: what a fit knows of the way from residuals to a cost. Members are in
greybox/estimation/criteria."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Protocol

from greybox.estimation.predictor import Block
from greybox.estimation.solver import Value

if TYPE_CHECKING:
    from greybox.estimation.problem import Problem


class Criterion(Protocol):
    """Turns residuals into a cost."""

    @property
    def name(self) -> str:
        """Catalogue name."""

    def evaluate(
        self, problem: Problem, blocks: Iterable[Block], order: int, scores: int | None
    ) -> Value:
        """Cost without priors (order 0), with gradient and Gauss-Newton Hessian (order 1).

        `scores`: also the gradients of consecutive stretches of so many samples. Raises `FitError`.
        """
