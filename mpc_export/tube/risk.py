"""From a risk per flight to standard deviations per constraint and sample: Boole's inequality, and nothing hidden.

A flight of which the plan touches its limits at n (sample, constraint) pairs keeps all of them with probability 1 - level
where each pair fails with probability level / n, whatever their dependence (Boole). A Gaussian error then asks for
kappa = Phi^-1(1 - level / n) standard deviations. Pairs that the plan does not touch are far from their limits and are
not counted: `touched` counts them in plans flown without tightening.
"""

from __future__ import annotations

import math

from scipy.stats import norm

from greybox.errors import ModelError
from mpc_export.tube.solver import TubeSolver
from mpc_export.tube.stages import block


def kappa(level: float, pairs: float) -> float:
    """Standard deviations for a risk `level` (0 to 1) per flight that touches `pairs` limits. Raises `ModelError`."""
    if not 0 < level < 1:
        raise ModelError("the risk per flight lies between 0 and 1", got=f"{level:g}")
    if not (math.isfinite(pairs) and pairs >= 1):
        raise ModelError("a flight touches at least one limit", got=f"{pairs:g}")
    return float(max(0.0, norm.ppf(1 - level / pairs)))


def touched(solver: TubeSolver, near: float = 2e-3) -> int:
    """Planes that the state after the first stage of the present plan touches: closer than `near` [m]."""
    data = solver.data
    place = block(solver.model, "position")
    planes = data["plane"][1]
    left = planes[:, 3] - planes[:, :3] @ data["x"][1][place]
    there = (planes[:, :3] ** 2).sum(axis=1) > 0
    return int((there & (left < near)).sum())
