"""Gauss-Newton with step halving: the full step of the Gauss-Newton (Fisher scoring) model, halved
until the cost falls.

Nocedal and Wright 2006, Numerical Optimization, sec. 3.1 (sufficient decrease) and 10.3. Undamped:
quick near the optimum, without the safety of Levenberg-Marquardt far from it. Bounds by projection;
steps of noise levels in their variances, as there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from greybox.estimation.solver import Objective, Progress
from greybox.estimation.solvers.levenberg_marquardt import FALL, damped_step, is_level, moved_by
from greybox.estimation.status import Code, Interrupted, Status
from greybox.symbolic import FloatArray

SUFFICIENT = 0.1
"""Share of the decrease that the slope promises which a step must bring: one that overshoots to the
other side of the valley brings next to nothing, and the next one back."""


@dataclass(frozen=True, kw_only=True)
class GaussNewton:
    """Stops when a full step promises a decrease of the cost below `tolerance` (see
    LevenbergMarquardt)."""

    name: str = "gauss-newton"
    tolerance: float = 1e-6
    max_iterations: int = 60
    max_halvings: int = 20

    def solve(
        self, problem: Objective, start: FloatArray, progress: Progress | None = None
    ) -> tuple[FloatArray, Status]:
        """Minimise from `start`; the best point and a status. Raises `Interrupted`, which holds
        both."""
        lower, upper = problem.lower, problem.upper
        x = np.clip(start, lower, upper)
        value = problem.evaluate(x)
        evaluations, iteration, decrement = 1, 0, np.inf
        if not value.valid:
            return x, Status(code=Code.INVALID_START, iterations=0, evaluations=1, decrement=np.inf)
        fall = np.where(is_level(problem), FALL, -np.inf)
        code = Code.MAX_ITERATIONS
        try:
            for iteration in range(1, self.max_iterations + 1):
                assert value.gradient is not None and value.hessian is not None
                g = value.gradient
                held = ((x <= lower) & (g > 0)) | ((x >= upper) & (g < 0))
                step = damped_step(g, value.hessian, held, 0.0)
                decrement = max(-0.5 * float(g @ step), 0.0)
                if progress:
                    progress(iteration, value.cost, decrement)
                if decrement < self.tolerance:
                    code = Code.CONVERGED
                    break
                share = 1.0
                for _ in range(self.max_halvings):
                    part = np.clip(share * step, np.maximum(lower - x, fall), upper - x)
                    new = moved_by(x, part, problem)
                    trial = problem.evaluate(new)
                    evaluations += 1
                    if trial.valid and trial.cost <= value.cost + SUFFICIENT * min(
                        float(g @ (new - x)), 0.0
                    ):
                        break
                    share *= 0.5
                else:
                    # Near the optimum rounding of the cost hides the decrease.
                    code = Code.CONVERGED if decrement < 1e3 * self.tolerance else Code.NO_PROGRESS
                    break
                x, value = new, trial
        except KeyboardInterrupt:
            code = Code.INTERRUPTED
        status = Status(
            code=code, iterations=iteration, evaluations=evaluations, decrement=float(decrement)
        )
        if code is Code.INTERRUPTED:
            raise Interrupted((x, status))
        return x, status
