"""Few samples: when there are too few for a fit, and what the doubt about noise levels adds to the errors.

The Fisher covariance takes the noise levels for known. In a second of data they are not: one that comes
out five times too small by chance makes the errors five times too small. With the levels l unknown, the
law of total variance gives

    Cov(theta) = E_l[Cov(theta | l)] + Cov_l(E[theta | l]),    log l normal about its estimate,

by three-point Gauss-Hermite quadrature of one level at a time (they hardly correlate: what a level says
of another is small against its own spread), E[theta | l] one Newton step from the estimate. The same
thought gives Student's t for a mean; the general form is that of Kenward and Roger (1997, Biometrics
53(3)) for variance components.
"""

from __future__ import annotations

import numpy as np

from greybox.errors import DataError
from greybox.estimation.covariance import scaled_inverse
from greybox.estimation.problem import Problem
from greybox.symbolic import BoolArray, FloatArray

KNOWN = 0.05
"""Standard deviation of the logarithm of a level below which it adds less than 1 % to a variance."""
DOUBTFUL = 1.0
"""Standard deviation of the logarithm that no level is taken to exceed: beyond, a level that the data
hardly see would decide."""


def demand_samples(problem: Problem) -> None:
    """Raise `DataError` where there are fewer samples than unknowns (initial states left out: they are
    read off the data)."""
    samples = sum(int((r.mask != 0).any(axis=1).sum()) for r in problem.records)
    unknowns = sum(u.kind != "initial" for u in problem.unknowns)
    if samples < unknowns:
        raise DataError(
            f"{samples} samples are fewer than the {unknowns} unknowns",
            fix="pass a longer flight, or hold parameters (--fixed) and noise levels (--hold-noise)",
        )


def doubt_of_levels(
    problem: Problem, theta: FloatArray, fisher: FloatArray, held: BoolArray
) -> FloatArray:
    """What noise levels that are not known add to the covariance of the other unknowns, (n, n)."""
    n = problem.n
    noise = np.array([u.kind == "noise" for u in problem.unknowns], dtype=bool)
    others = np.flatnonzero(~noise & ~held)
    added = np.zeros((n, n))
    if not others.size:
        return added
    inside = np.ix_(others, others)
    total = np.zeros((others.size, others.size))
    for i in np.flatnonzero(noise & ~held):
        std = float(np.sqrt(max(fisher[i, i], 0.0)))
        if not std > KNOWN:
            continue
        step = np.sqrt(3.0) * (min(std, DOUBTFUL) if np.isfinite(std) else DOUBTFUL)
        for sign in (-1.0, 1.0):
            at = theta.copy()
            at[i] = np.clip(theta[i] + sign * step, problem.lower[i], problem.upper[i])
            value = problem.evaluate(at)
            if value.hessian is None or value.gradient is None:
                continue
            inverse, _ = scaled_inverse(value.hessian[inside])
            move = inverse @ value.gradient[others]
            total += (inverse + np.outer(move, move) - fisher[inside]) / 6.0
    size, vector = np.linalg.eigh(0.5 * (total + total.T))
    added[inside] = (vector * np.maximum(size, 0.0)) @ vector.T
    return added
