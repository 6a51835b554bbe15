"""Predictions that run on alone from the states of a filter: what they have of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from greybox.estimation.predictor import Predictor
from greybox.estimation.predictors.innovation import Innovation, InnovationPrepared
from greybox.symbolic import BoolArray

if TYPE_CHECKING:
    from greybox.estimation.problem import Problem


@dataclass(frozen=True, kw_only=True)
class FromFilter(Predictor[InnovationPrepared]):
    """A predictor that begins with the states of its `filter`."""

    filter: Innovation = field(default_factory=Innovation)

    @property
    def one_step(self) -> Innovation:
        """The filter that the predictions start from."""
        return self.filter

    def prepare(self, problem: Problem) -> InnovationPrepared:
        """As the innovation form."""
        return problem.prepared(self.filter)

    @property
    def carries_starts(self) -> bool:
        """As the innovation form."""
        return True

    def told(self, problem: Problem) -> list[BoolArray]:
        """As the innovation form."""
        return self.filter.told(problem)
