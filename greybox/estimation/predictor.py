"""Predictor: what a fit knows of the way from unknowns to residuals. Members are in
greybox/estimation/predictors.

A predictor says what it has by the properties below; nothing is found out by probing. What it works
out once per problem is a frozen record of its own, which it gets back, typed, from the problem:

    @dataclass(frozen=True, kw_only=True)
    class Mine(Predictor[MinePrepared]):
        name: str = "mine"

        def prepare(self, problem): return MinePrepared(...)

        def blocks(self, problem, theta, jacobian):
            prepared = problem.prepared(self)  # a MinePrepared
            ...
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, TypeVar

import numpy as np
import numpy.typing as npt

from greybox.estimation.record import Record
from greybox.estimation.solver import IndexArray, Progress
from greybox.symbolic import BoolArray, FloatArray

if TYPE_CHECKING:
    from greybox.estimation.problem import Problem

Prepared_co = TypeVar("Prepared_co", covariant=True)
"""The record that a predictor prepares; None where there is nothing to prepare."""


@dataclass(frozen=True, kw_only=True)
class Block:
    """What one record adds to the criterion: residuals and how they depend on the unknowns.

    e (n, n_e) with zeros where mask (n, n_e) is 0; jacobian (n, n_e, n_s) or None; columns (n_s,)
    their places among the unknowns; covariance (n_pat, n_e, n_e) with unit diagonal for missing
    channels and its derivative per pattern (n_k, n_e, n_e) in the first n_k columns, or None where
    the criterion estimates the weights itself; pattern (n,). A time-varying predictor gives
    decorrelated residuals instead, with `variance` (n, n_e; 1 where missing) and its derivative (n,
    n_e, n_s). Rows of one `group` (n,) share a variance of their own per channel; `weight` is what
    one row counts, `spacing` how many samples lie between two rows of one group.
    """

    record: Record
    e: FloatArray
    mask: FloatArray
    jacobian: FloatArray | None
    columns: IndexArray
    covariance: FloatArray | None
    covariance_slope: tuple[FloatArray, ...] | None
    pattern: npt.NDArray[np.int32]
    variance: FloatArray | None = None
    variance_slope: FloatArray | None = None
    group: npt.NDArray[np.int32] | None = None
    weight: float = 1.0
    spacing: float = 1.0


class Predictor(ABC, Generic[Prepared_co]):
    """Turns unknowns into residuals. Abstract are `name`, `prepare` and `blocks`; the rest has
    defaults.

    A predictor is a value: a frozen dataclass, or any object that can be hashed. Equal predictors
    share what they prepare for a problem. Members are final: what two of them share is a base class
    without instances.
    """

    @property
    @abstractmethod
    def name(self) -> str:
        """Catalogue name."""

    @property
    def has_noise(self) -> bool:
        """Whether noise levels are unknowns of the fit; by default they are held."""
        return False

    @property
    def has_initial(self) -> bool:
        """Whether initial states are unknowns of the fit; False: their prior is all that is used of
        them."""
        return True

    @property
    def carries_starts(self) -> bool:
        """Whether errors of the starts may be integrated out instead of being unknowns, see
        `told`."""
        return False

    def told(self, problem: Problem) -> list[BoolArray]:
        """Which initial errors (n_d,) of every record its filter carries as a covariance; none by
        default.

        Asked only of a predictor that `carries_starts`, before the initial errors are among the
        unknowns of `problem`.
        """
        return [np.zeros(len(problem.dynamics.error_states), dtype=bool) for _ in problem.records]

    @property
    def horizons(self) -> tuple[int, ...]:
        """How many samples ahead the residuals look; 1 is the next one."""
        return (1,)

    @property
    def one_step(self) -> Predictor[object]:
        """The one-step filter that gives the innovations: of a predictor that looks further ahead
        the filter it starts from, else itself."""
        return self

    @property
    def misfit_is_sensor_noise(self) -> bool:
        """Whether all misfit counts as noise of the sensors, whose levels then are the RMS of the
        residuals."""
        return not self.has_noise and self.one_step is self

    @abstractmethod
    def prepare(self, problem: Problem) -> Prepared_co:
        """Work that is done once per problem: a frozen record, which `problem.prepared(self)` hands
        back."""

    @abstractmethod
    def blocks(self, problem: Problem, theta: FloatArray, jacobian: bool) -> Iterable[Block]:
        """Residuals of every record at `theta` (n,), in the order of the records. Raises
        `FitError`."""

    def approach(
        self, problem: Problem, start: FloatArray, progress: Progress | None = None
    ) -> FloatArray:
        """Unknowns (n,) that the solver starts from; by default `start`, unchanged."""
        return start
