"""Solver: what a fit knows of who minimises, and what a solver sees. Members are in
greybox/estimation/solvers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from greybox.estimation.status import Status
from greybox.estimation.unknown import Unknown
from greybox.symbolic import FloatArray

IndexArray = npt.NDArray[np.intp]
Progress = Callable[[int, float, float], None]
"""Called every iteration with its number, the cost and the decrease that one more full step
promises."""


@dataclass(frozen=True, kw_only=True)
class Value:
    """Cost (negative log posterior up to nothing: constants included), gradient, Gauss-Newton
    Hessian, block scores.

    `scores` (n_blocks, n): gradient of consecutive stretches, for the sandwich covariance.
    `likelihood` is the cost without priors. `valid` False: the model's numbers stopped being
    finite.
    """

    cost: float
    likelihood: float
    gradient: FloatArray | None = None
    hessian: FloatArray | None = None
    data_hessian: FloatArray | None = None
    scores: FloatArray | None = None
    valid: bool = True


class Objective(Protocol):
    """What a solver sees of a problem: a cost over n unknowns within bounds."""

    @property
    def n(self) -> int:
        """Number of unknowns."""

    @property
    def unknowns(self) -> tuple[Unknown, ...]:
        """The unknowns, in the order of all vectors."""

    @property
    def lower(self) -> FloatArray:
        """Lower bounds (n,)."""

    @property
    def upper(self) -> FloatArray:
        """Upper bounds (n,)."""

    @property
    def scale(self) -> FloatArray:
        """Typical sizes (n,)."""

    def evaluate(self, theta: FloatArray, order: int = 1, scores: int | None = None) -> Value:
        """Cost at `theta` (n,); order 1 adds gradient and Hessian."""


class Solver(Protocol):
    """Minimises the cost of an `Objective`."""

    @property
    def name(self) -> str:
        """Catalogue name."""

    def solve(
        self, problem: Objective, start: FloatArray, progress: Progress | None = None
    ) -> tuple[FloatArray, Status]:
        """(estimate (n,), status) from `start` (n,). Raises `Interrupted`, which holds both."""
