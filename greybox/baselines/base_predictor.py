"""BasePredictor: an identified model as a predictor of measured channels in innovation form.

    x(t+1|t) = f(x(t|t-1), u) (+) K e(t),    y(t) = h(x(t|t-1), u) + e(t),    cov(e) = S

x(t|t-1) is known without any measurement of time t. A linear model brings K and S, a physical one
those of its stationary filter (Ljung 1999, System Identification, sec. 4.3). Which of the two a
model is, `greybox.baselines.as_predictor` alone asks.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Self

import numpy as np
import numpy.typing as npt

from greybox.baselines.decoupled import Terms
from greybox.baselines.innovation_ahead import run_with_spread
from greybox.baselines.innovation_step import InnovationSteps
from greybox.baselines.kinematics import IMU
from greybox.baselines.predictor_run import Run
from greybox.data import Segment
from greybox.errors import DataError, UnknownNameError
from greybox.model.dynamics import Dynamics
from greybox.model.identified import IdentifiedModel
from greybox.model.linear import LinearModel
from greybox.symbolic import Expr, FloatArray

Base = LinearModel | IdentifiedModel


@dataclass(frozen=True, kw_only=True, eq=False)
class BasePredictor(ABC):
    """Predicts `outputs` of `model` (default: the IMU channels among its outputs, else all that are
    plain numbers); a `Predictor` of `greybox.baselines.regressors`.

    `adapt` [s]: what differs from flight to flight is fitted on the first seconds of every segment,
    where nothing is then predicted. Raises `UnknownNameError`.
    """

    model: Base
    outputs: tuple[str, ...] = ()
    adapt: float | None = None
    train_seconds: float = 0.0
    kind: ClassVar[str]

    def __post_init__(self) -> None:
        plain = [c[0] for c in self.dynamics.innovation_columns if len(c) == 1]
        chosen = self.outputs or tuple(n for n in plain if n in IMU) or tuple(plain)
        for n in chosen:
            if n not in plain:
                raise UnknownNameError("output", n, plain, where=self.dynamics.name)
        object.__setattr__(self, "outputs", tuple(chosen))

    # --------------------------------------------------------------- what each kind says of itself

    @property
    @abstractmethod
    def gain(self) -> tuple[FloatArray, FloatArray]:
        """(K (n_d, n_e), S (n_e, n_e)) with all channels measured."""

    @property
    @abstractmethod
    def parameters(self) -> int:
        """How many numbers were fitted."""

    @property
    @abstractmethod
    def commands(self) -> tuple[str, ...]:
        """Log columns that drive the model."""

    @property
    @abstractmethod
    def run_in(self) -> float:
        """Seconds [s] after which the start of a segment is forgotten."""

    @property
    @abstractmethod
    def offsets(self) -> tuple[str, ...]:
        """Outputs whose offset is found anew on every flight."""

    @property
    @abstractmethod
    def reference(self) -> tuple[FloatArray, Mapping[str, float]]:
        """State (n_x,) that the model is usually in, and what it knows of its usual commands."""

    @property
    @abstractmethod
    def n_p(self) -> int:
        """Length of the argument p of the functions, that of `Run.p`."""

    @abstractmethod
    def numbers(self, p: Expr) -> Expr:
        """The model's parameter vector from the argument p (n_p,)."""

    @abstractmethod
    def default_features(
        self, angles: Sequence[str], commands: Sequence[str], earlier: Sequence[str]
    ) -> tuple[str, ...]:
        """What foretells the model's errors, of `angles`, `commands` and `earlier` ones of the
        log and of what it predicts itself."""

    @abstractmethod
    def _run(self, segment: Segment) -> Run:
        """Predictions of a segment of the model's own sample time."""

    def terms(self, name: str) -> Terms:
        """(weight, log column) of the sum that the model's input `name` is."""
        return ((1.0, name),)

    def to_dict(self) -> dict[str, object]:
        """What `greybox.baselines.as_predictor.from_dict` reads."""
        return {
            "base": self.model.to_dict(),
            "channels": {},
            "outputs": list(self.outputs),
            "adapt": self.adapt,
            "base_seconds": self.train_seconds,
        }

    # -------------------------------------------------------------------------------- what all are

    @property
    def dynamics(self) -> Dynamics:
        """The model's equations."""
        return self.model.dynamics

    @property
    def dt(self) -> float:
        """Sample time [s]."""
        return self.model.sample_time

    @property
    def rows(self) -> list[int]:
        """Places of the outputs among the innovations."""
        columns = list(self.dynamics.innovation_columns)
        return [columns.index((n,)) for n in self.outputs]

    @cached_property
    def steps(self) -> InnovationSteps:
        """Its recursion as functions."""
        return InnovationSteps(self)

    def unadapted(self) -> Self:
        """The same without adaptation to the flight."""
        return replace(self, adapt=None)

    # ------------------------------------------------------------------------------------- predict

    def run(self, segment: Segment) -> Run:
        """Predictions of a whole segment. Raises `DataError` (a column is absent, too short),
        `FitError`."""
        if abs(segment.dt - self.dt) > 1e-6 * self.dt:
            raise DataError(
                f"sampled every {segment.dt:g} s, the model every {self.dt:g} s",
                where=f"flight {segment.flight}",
                fix=f"read the log with --rate {1 / self.dt:g}",
            )
        return self._run(segment)

    def one_step(self, segment: Segment) -> tuple[FloatArray, FloatArray]:
        """Mean and variance (n, n_o) of every sample from what is known before it; NaN where too
        little is."""
        run = self.run(segment)
        mean = np.where(run.known[:, None], run.mean, np.nan)
        variance = np.broadcast_to(np.diag(self.gain[1])[self.rows], mean.shape)
        return mean, np.where(np.isfinite(mean), variance, np.nan)

    def free_run(
        self, segment: Segment, origins: npt.ArrayLike, horizon: int
    ) -> tuple[FloatArray, FloatArray]:
        """Mean and variance (m, horizon, n_o) of the samples k+1 .. k+horizon from every origin
        k."""
        return run_with_spread(self, segment, origins, horizon)
