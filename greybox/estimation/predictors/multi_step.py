"""Multi-step prediction: from filter states along the flight the model runs on alone, judged at
several horizons.

    e_(k,h) = y_(k+h) - h(F^h(x_hat(k | k-1))),   k every `stride` samples, h in `horizons`

A model for control is used open loop over a horizon; where the noise is not what the filter assumes
(streams that drift against each other, coloured torque) the one-step likelihood trades long-run
accuracy for it. The gain follows from noise levels that are held. Errors are weighed per horizon
and channel (their variances are concentrated out), so that no horizon dominates. Errors from
neighbouring samples share almost everything that caused them: one longest horizon of samples counts
as one observation, or priors would be worth nothing. (Shook, Mohtadi and Shah 1992, A
control-relevant identification strategy for GPC, IEEE TAC 37(7); Farina and Piroddi 2011,
Simulation error minimization, Int. J. Control 84(2).)
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
from greybox.estimation.settling import RecordGains
from greybox.symbolic import FloatArray

if TYPE_CHECKING:
    from greybox.estimation.problem import Problem


@final
@dataclass(frozen=True, kw_only=True)
class MultiStep(FromFilter):
    """Errors at `horizons` (samples, 1 = one step) from every `stride`-th sample. Errors overlap:
    use sandwich errors."""

    horizons: tuple[int, ...] = (1, 2, 5, 10, 20, 30, 50)
    stride: int = 15
    name: str = "multi-step"

    def __post_init__(self) -> None:
        if not self.horizons or min(self.horizons) < 1 or self.stride < 1:
            raise ModelError(
                "horizons and stride must be one sample or more",
                got=f"{self.horizons}, {self.stride}",
            )

    def blocks(self, problem: Problem, theta: FloatArray, jacobian: bool) -> Iterable[Block]:
        """Errors of every record, windows in order of time and horizons inside each window."""
        filters = self.filter.gains(problem, theta, jacobian)
        return problem.map_records(lambda i: self._block(problem, theta, i, filters[i], jacobian))

    def _block(
        self, problem: Problem, theta: FloatArray, i: int, gains: RecordGains, jacobian: bool
    ) -> Block:
        """Errors of record i, ahead from every state of its filter."""
        engine, record = problem.engine, problem.records[i]
        chosen = np.array(sorted(set(self.horizons))) - 1
        length = min(int(chosen[-1]) + 1, record.n)
        at = chosen[chosen < length]
        p = problem.parameters_of(theta, record.flight)
        states, slopes, columns = filtered_states(problem, theta, i, gains, jacobian)
        rows = np.arange(0, record.n - length + 1, self.stride)
        whole = np.full(rows.size, length)
        ahead = engine.windows(
            starts=states[rows],
            rows=rows,
            lengths=whole,
            tails=whole,
            p=p,
            s0=None if slopes is None else slopes[rows],
            steps=at,
            **record.samples,
        )
        ahead.demand_finite(f"the prediction of flight {record.flight}", rows)
        return Block(
            record=record,
            e=ahead.innovations,
            mask=record.mask[(rows[:, None] + at).ravel()],
            jacobian=ahead.sensitivity,
            columns=columns,
            covariance=None,
            covariance_slope=None,
            pattern=record.pattern,
            group=np.tile(np.arange(at.size, dtype=np.int32), rows.size),
            weight=self.stride / (at.size * length),
            spacing=float(self.stride),
        )
