"""A search of a solver, done once: what an earlier run of the same work found is taken from its
journal (`greybox.journal`)."""

from __future__ import annotations

from dataclasses import dataclass

from greybox.estimation.solver import Objective, Progress, Solver
from greybox.estimation.status import Code, Status
from greybox.journal import answers
from greybox.symbolic import FloatArray


@dataclass(frozen=True, eq=False)
class Ended:
    """Where a search ended: the unknowns `theta` (n,) and how."""

    theta: FloatArray
    status: Status


def solved(
    problem: Objective, solver: Solver, start: FloatArray, progress: Progress | None = None
) -> tuple[FloatArray, Status]:
    """What `solver` finds from `start` (n,): the unknowns (n,) and how it ended. Raises
    `Interrupted`."""
    (ended,) = answers(
        [[type(solver).__name__, start.tolist()]],
        lambda _: [(0, Ended(*solver.solve(problem, start, progress)))],
        Ended,
        (Ended, Status, Code),
    )
    return ended.theta, ended.status
