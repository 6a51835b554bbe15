"""Multistart: the same fit from many starts, to see whether its optimum is the only one."""

from __future__ import annotations

import concurrent.futures
import functools
import threading
from dataclasses import dataclass

import numpy as np

from greybox.cores import cores
from greybox.estimation.problem import Problem
from greybox.estimation.solver import Solver
from greybox.estimation.status import Status
from greybox.symbolic import FloatArray


@dataclass(frozen=True, kw_only=True)
class Multistart:
    """All runs of a multistart, best first: theta (n_runs, n), cost (n_runs,), status per run.

    `spread` is the largest cost minus the smallest among the runs that converged, `agreeing` how
    many runs reached the best cost within 0.01 (a hundredth of what matters for the estimates).
    """

    theta: FloatArray
    cost: FloatArray
    status: tuple[Status, ...]

    @property
    def best(self) -> FloatArray:
        """Estimate of the best run, (n,)."""
        return self.theta[0]

    @property
    def agreeing(self) -> int:
        """Number of runs within 0.01 of the best cost."""
        return int((self.cost <= self.cost[0] + 0.01).sum())

    @property
    def spread(self) -> float:
        """Largest minus smallest cost of the runs that converged; NaN where none did."""
        good = self.cost[[s.converged for s in self.status]]
        return float(good.max() - good.min()) if good.size else float("nan")


def random_start(
    problem: Problem, rng: np.random.Generator, base: FloatArray, width: float = 1.0
) -> FloatArray:
    """One random start: parameters within their priors or bounds, noise levels within a factor
    e^(width/2) or so.

    A finite prior: normal around its mean. Else two finite bounds: uniform between them (of
    logarithms, where both are positive and a factor 100 or more apart). Else normal around `base`
    with the declared scale. Initial states stay.
    """
    out = np.array(base, dtype=np.float64)
    for i, u in enumerate(problem.unknowns):
        draw = rng.standard_normal(), rng.uniform()  # the same number of draws for every unknown
        if u.kind == "noise":
            out[i] += 0.5 * width * draw[0]
        elif u.kind == "parameter":
            if np.isfinite(u.sigma):
                out[i] = u.mean + width * u.sigma * draw[0]
            elif np.isfinite(u.lower) and np.isfinite(u.upper):
                if u.lower > 0 and u.upper >= 100 * u.lower:
                    out[i] = u.lower * (u.upper / u.lower) ** draw[1]
                else:
                    out[i] = u.lower + (u.upper - u.lower) * draw[1]
            else:
                out[i] += width * u.scale * draw[0]
    return problem.inside(out)


def multistart(
    problem: Problem,
    solver: Solver,
    *,
    n: int = 8,
    seed: int = 0,
    base: FloatArray | None = None,
    width: float = 1.0,
    executor: concurrent.futures.Executor | None = None,
) -> Multistart:
    """Solve from `base` (default: the problem's start) and from n - 1 random starts, side by side.

    `executor` defaults to threads, one per core (the compiled recursion runs outside Python's
    lock). The starts depend on `seed` alone, never on the order in which runs end.
    """
    base = problem.start if base is None else base
    rng = np.random.default_rng(seed)
    starts = [base, *(random_start(problem, rng, base, width) for _ in range(n - 1))]
    if executor is None:
        stop = threading.Event()
        with concurrent.futures.ThreadPoolExecutor(cores()) as pool:
            try:
                runs = list(
                    pool.map(functools.partial(_one_run, problem, solver, stop=stop), starts)
                )
            finally:  # an interrupt reaches the main thread only
                stop.set()
    else:
        runs = list(executor.map(functools.partial(_one_run, problem, solver), starts))
    cost = np.array([c for _, c, _ in runs])
    order = np.argsort(cost, kind="stable")
    return Multistart(
        theta=np.array([runs[i][0] for i in order]),
        cost=cost[order],
        status=tuple(runs[i][2] for i in order),
    )


def _one_run(
    problem: Problem, solver: Solver, start: FloatArray, stop: threading.Event | None = None
) -> tuple[FloatArray, float, Status]:
    def progress(*_: float) -> None:
        if stop is not None and stop.is_set():
            raise KeyboardInterrupt

    theta, status = solver.solve(problem, start, progress)
    return theta, problem.evaluate(theta, 0).cost, status
