"""From a risk per flight to standard deviations per constraint and sample, in three ways that
assume ever less room.

*Boole* (`kappa`): a flight of which the plan touches its limits at n (sample, constraint) pairs
keeps all of them with probability 1 - level where each pair fails with probability level / n,
whatever their dependence. A Gaussian error then asks for kappa = Phi^-1(1 - level / n) standard
deviations. Pairs that the plan does not touch are far from their limits and are not counted:
`touched` counts them in plans flown without tightening.

*Passages* (`kappa_passages`): neighbours in time fail together. A passage is a stretch of plans
that touch one limit without a break; Boole counts passages, and within one the probability that any
of m stages fails is that of the largest of m Gaussians with the correlation of the closed loop
(correlation.py), which Slepian's and Sidak's inequalities (Slepian 1962; Sidak 1967, J. American
Statistical Association 62) bound by the independent case. It holds for a plan that is followed with
the ancillary gain from the passage's begin on; what planning anew gains is not counted.

*Rehearsal* (`kappa_rehearsed`): back-offs chosen by simulating the closed loop, planning anew
included, on the identified model with its own noise, parameter and learned errors drawn per flight
(Paulson and Mesbah 2018, Int. J. Robust Nonlinear Control 28(16); Bradford et al. 2020, Computers
and Chemical Engineering 139). It sees no flight of the real vehicle but the one that the model was
identified from, and is as right as the model's uncertainty is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import scipy.optimize
from scipy.stats import norm

from greybox.errors import ModelError
from greybox.frames import numeric
from greybox.symbolic import FloatArray
from mpc_export.semidefinite import upper_half
from mpc_export.tube.solver import TubeSolver
from mpc_export.tube.stages import block

DRAWS = 100_000
"""Gaussian passages that are drawn to find how large their largest value is."""


def _checked(level: float) -> float:
    if not 0 < level < 1:
        raise ModelError("the risk per flight lies between 0 and 1", got=f"{level:g}")
    return level


def kappa(level: float, pairs: float) -> float:
    """Standard deviations for a risk `level` (0 to 1) per flight that touches `pairs` limits.
    Raises `ModelError`."""
    _checked(level)
    if not (math.isfinite(pairs) and pairs >= 1):
        raise ModelError("a flight touches at least one limit", got=f"{pairs:g}")
    return float(max(0.0, norm.ppf(1 - level / pairs)))


def touching(solver: TubeSolver, near: float = 2e-3) -> npt.NDArray[np.bool_]:
    """(planes + 1,) Which limits the state after the first stage of the present plan touches:
    planes, then the tilt.

    near: closer than this [m], or in the cosine of the tilt.
    """
    data = solver.data
    x = data["x"][1]
    planes = data["plane"][1]
    left = planes[:, 3] - planes[:, :3] @ x[block(solver.model, "position")]
    there = (planes[:, :3] ** 2).sum(axis=1) > 0
    up = numeric("rotate", x[block(solver.model, "attitude")], [0.0, 0.0, 1.0])[0][2]
    return np.append(there & (left < near), up - math.cos(solver.problem.tilt_max) < near)


def touched(solver: TubeSolver, near: float = 2e-3) -> int:
    """Limits that the state after the first stage of the present plan touches; see `touching`."""
    return int(touching(solver, near).sum())


def passages(rows: npt.ArrayLike, gap: int = 5) -> list[int]:
    """Lengths [plans] of the passages in `rows` (plans, limits) of `touching`; breaks of up to
    `gap` plans join."""
    found = []
    for column in np.asarray(rows, dtype=bool).T:
        on = np.flatnonzero(column)
        for part in np.split(on, np.flatnonzero(np.diff(on) > gap + 1) + 1) if on.size else ():
            found.append(int(part[-1] - part[0] + 1))
    return found


def kappa_passages(
    level: float, lengths: Sequence[int], correlation: FloatArray, *, flights: int = 1
) -> float:
    """Standard deviations for a risk `level` per flight, where `flights` flights had passages of
    `lengths` [stages].

    correlation (m, m): of the deviations over the stages of a passage; longer passages count as
    whole numbers of m and a rest. The largest value of a passage is found by `DRAWS` seeded draws.
    Raises `ModelError`.
    """
    _checked(level)
    m = len(correlation)
    if not lengths or min(lengths) < 1 or flights < 1:
        raise ModelError(
            "passages have at least one stage, and there is one",
            got=f"{list(lengths)}, {flights} flights",
        )
    parts = [m] * sum(n // m for n in lengths) + [n % m for n in lengths if n % m]
    root = upper_half(np.asarray(correlation)).T
    largest = np.maximum.accumulate(
        np.random.default_rng(0).standard_normal((DRAWS, m)) @ root.T, axis=1
    )
    sizes, counts = np.unique(parts, return_counts=True)
    tails = [np.sort(largest[:, n - 1]) for n in sizes]

    def excess(value: float) -> float:
        each = [1.0 - np.searchsorted(t, value) / DRAWS for t in tails]
        return float(counts @ each / flights - level)

    if excess(0.0) <= 0:
        return 0.0
    return float(scipy.optimize.brentq(excess, 0.0, 10.0, xtol=1e-4))


def kappa_rehearsed(
    level: float,
    tried: Sequence[float],
    failed: Sequence[int],
    flights: Sequence[int],
    *,
    surety: float = 0.8,
) -> float:
    """Standard deviations at which rehearsed flights fail with probability `level`, with `surety`
    on the safe side.

    tried: standard deviations of the rehearsals, `failed` of `flights` flights each. A probit line,
    Phi^-1(rate) = a - b kappa, is fitted by maximum likelihood (Finney 1971, Probit Analysis; a
    prior of half a flight of either outcome keeps it finite), and kappa solves a - b kappa + z se =
    Phi^-1(level), se the line's standard error there. Raises `ModelError`.
    """
    _checked(level)
    x, hits, n = (np.asarray(v, dtype=float) for v in (tried, failed, flights))
    if (
        len(np.unique(x)) < 2
        or not x.shape == hits.shape == n.shape
        or (hits > n).any()
        or (n < 1).any()
    ):
        raise ModelError("rehearsals need flights at two or more back-offs", got=f"{list(tried)}")
    hits, n = hits + 0.5, n + 1.0
    design = np.column_stack([np.ones_like(x), -x])

    def loss(v: FloatArray) -> float:
        at = design @ v
        return -float(hits @ norm.logcdf(at) + (n - hits) @ norm.logcdf(-at))

    # a larger back-off never makes a flight riskier
    best = scipy.optimize.minimize(loss, [0.0, 1.0], bounds=[(-20.0, 20.0), (1e-3, 20.0)]).x
    at = np.clip(design @ best, -8, 8)
    weight = n * norm.pdf(at) ** 2 / (norm.cdf(at) * norm.cdf(-at))
    covariance = np.linalg.inv((design.T * weight) @ design)
    z, goal = norm.ppf(surety), norm.ppf(level)

    def excess(value: float) -> float:
        row = np.array([1.0, -value])
        return float(row @ best + z * math.sqrt(row @ covariance @ row) - goal)

    most = 2.0 * float(x.max())
    if excess(0.0) <= 0:
        return 0.0
    if excess(most) > 0:
        raise ModelError(
            f"rehearsed flights fail too often for a risk of {level:g} up to {most:g} standard "
            "deviations",
            fix="rehearse with larger back-offs or more flights",
        )
    return float(scipy.optimize.brentq(excess, 0.0, most, xtol=1e-4))
