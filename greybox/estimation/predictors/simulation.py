"""Pure simulation (output error): no correction, K = 0; the model runs on its own from a free
initial state.

    x(k+1) = F(x(k), u_k),   e_k = y_k - h(x(k), u_k)

All misfit is sensor noise; the criterion estimates its level. (Ljung 1999, System Identification,
eq. 4.25; Jategaonkar 2015, Flight Vehicle System Identification, ch. 4.) Biased where process noise
matters: use the innovation form there.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, final

import numpy as np

from greybox.estimation.predictor import Block, Predictor
from greybox.estimation.recursion import GainTable
from greybox.symbolic import FloatArray

if TYPE_CHECKING:
    from greybox.estimation.problem import Problem


@final
@dataclass(frozen=True, kw_only=True)
class Simulation(Predictor[None]):
    """Output error over whole records, each from its own initial state."""

    name: str = "simulation"

    def prepare(self, problem: Problem) -> None:
        """Nothing to prepare."""

    def blocks(self, problem: Problem, theta: FloatArray, jacobian: bool) -> Iterable[Block]:
        """Simulation errors of every record; the criterion weighs them."""
        engine = problem.engine

        def work(i: int) -> Block:
            record = problem.records[i]
            x0, s0, columns = start_of(problem, theta, i)
            count = len(record.patterns)
            run = engine.run(
                x0=x0,
                pattern=record.pattern,
                gains=GainTable(
                    gain=np.zeros((count, engine.nd, engine.ne)),
                    zero=np.ones(count, dtype=np.int32),
                ),
                p=problem.parameters_of(theta, record.flight),
                s0=s0 if jacobian else None,
                want=frozenset({"innovations", "sensitivity"}),
                **record.samples,
            )
            run.demand_finite(f"the simulation of flight {record.flight}")
            assert run.innovations is not None
            return Block(
                record=record,
                e=run.innovations,
                mask=record.mask,
                jacobian=run.sensitivity,
                columns=columns,
                covariance=None,
                covariance_slope=None,
                pattern=record.pattern,
            )

        return problem.map_records(work)


def start_of(
    problem: Problem, theta: FloatArray, record_index: int
) -> tuple[FloatArray, FloatArray, np.ndarray[tuple[int], np.dtype[np.intp]]]:
    """(x0 (n_x,), its sensitivity s0 (n_d, n_s), columns (n_s,)): active parameters first, then the
    initial error state."""
    columns = problem.local_columns(problem.records[record_index].flight)
    x0, slope = problem.start_of(theta, record_index)
    s0 = np.concatenate([np.zeros((problem.engine.nd, columns.size)), slope], axis=1)
    return x0, s0, np.concatenate([columns, problem.initial_columns(record_index)])
