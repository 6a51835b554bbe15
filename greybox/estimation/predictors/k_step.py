"""k-step-ahead prediction: the innovation form filters up to sample t - k, the model runs on alone
to sample t.

    x_hat(t-k+1 | t-k) from the stationary filter,   e_t = y_t - h(F^(k-1)(x_hat(t-k+1 | t-k))),   k = 1: innovations

(Ljung 1999, System Identification, sec. 3.2 and eq. 4.48; for control: Gevers 2005, European J. of
Control 11(4-5).) The gain follows from noise levels that are held (those of the problem: given, of
an earlier fit, or nominal) and from the parameters, exactly differentiated. Samples before the k-th
are predicted from the initial state. Errors of neighbouring samples overlap, so that they are
correlated up to lag k - 1: standard errors want the sandwich form.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, final

import numpy as np

from greybox.errors import ModelError
from greybox.estimation.predictor import Block
from greybox.estimation.predictors.from_filter import FromFilter
from greybox.estimation.predictors.innovation import filtered_states
from greybox.symbolic import FloatArray

if TYPE_CHECKING:
    from greybox.estimation.problem import Problem


@final
@dataclass(frozen=True, kw_only=True)
class KStep(FromFilter):
    """k-step-ahead prediction errors; k in samples."""

    k: int = 10
    name: str = "k-step"

    def __post_init__(self) -> None:
        if self.k < 1:
            raise ModelError("a prediction horizon must be one sample or more", got=str(self.k))

    @property
    def horizons(self) -> tuple[int, ...]:
        """k alone."""
        return (self.k,)

    def blocks(self, problem: Problem, theta: FloatArray, jacobian: bool) -> Iterable[Block]:
        """Errors of every record, one row per sample; the criterion weighs them."""
        engine = problem.engine
        filters = self.filter.gains(problem, theta, jacobian)

        def work(i: int) -> Block:
            record = problem.records[i]
            states, slopes, columns = filtered_states(problem, theta, i, filters[i], jacobian)
            k = min(self.k, record.n)
            rows = np.arange(record.n - k + 1)
            tails = np.ones(rows.size, dtype=np.int32)
            tails[0] = k
            ahead = engine.windows(
                starts=states[rows],
                rows=rows,
                lengths=np.full(rows.size, k),
                tails=tails,
                p=problem.parameters_of(theta, record.flight),
                s0=None if slopes is None else slopes[rows],
                **record.samples,
            )
            ahead.demand_finite(f"the prediction of flight {record.flight}")
            return Block(
                record=record,
                e=ahead.innovations,
                mask=record.mask,
                jacobian=ahead.sensitivity,
                columns=columns,
                covariance=None,
                covariance_slope=None,
                pattern=record.pattern,
            )

        return problem.map_records(work)
