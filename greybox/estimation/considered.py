"""Parameters that are held although their values are not exact: what their stated errors add to the
errors of the others, and whether the flights know them better than they are stated.

A held parameter that is off by d moves the estimates by S d, S = -H_uu^-1 H_uc with the Hessian of
the problem in which it is free (consider covariance: Schmidt 1966, Application of state-space
methods to navigation problems, Advances in Control Systems 3; Tapley, Schutz and Born 2004,
Statistical Orbit Determination, ch. 6). To hold a parameter is right where the flights say nothing
of it, as where only its ratio to another one shows. What they say is the Schur complement
H_cc - H_cu H_uu^-1 H_uc of the data's Hessian, without any prior. Where innovations are coloured
the scores of blocks say how much of that is worth (`greybox.estimation.covariance`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from greybox.data import Dataset
from greybox.errors import ModelError
from greybox.estimation.covariance import FEWEST_BLOCKS, scaled_eigen, scaled_inverse
from greybox.estimation.options import FitOptions
from greybox.estimation.problem import Problem, make_problem
from greybox.model.dynamics import Dynamics
from greybox.symbolic import FloatArray

Places = npt.NDArray[np.intp]
ROUNDING = 100 * float(np.finfo(float).eps)
"""Error of a Hessian's entries, relative to their diagonal: sums over all samples."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Considered:
    """`spread` (n, n): what stated errors add to the covariance of the unknowns. `moves`: name ->
    (stated error, how far every unknown moves (n,) per unit of this parameter). `told`: name ->
    (standard error that the flights alone give, stated error), of those where it is smaller."""

    spread: FloatArray | None = None
    moves: Mapping[str, tuple[float, FloatArray]] = field(default_factory=dict)
    told: Mapping[str, tuple[float, float]] = field(default_factory=dict)


NOTHING = Considered()
"""Of a fit that considers nothing."""


def demand_considerable(dynamics: Dynamics, options: FitOptions) -> None:
    """Raise `ModelError` for a considered parameter that is not held or has no stated error."""
    declared = {d.name: d for d in dynamics.parameters}
    for name in options.considered:
        if name not in options.fixed or name not in declared:
            raise ModelError(f"{name} is considered but not held", fix=f"--fixed {name}, too")
        given = options.priors.get(name)
        if not 0 < (declared[name].sigma if given is None else given[1]) < np.inf:
            raise ModelError(f"{name} is considered but has no stated error", fix="give it a sigma")


def considered(
    problem: Problem, data: Dataset, options: FitOptions, theta: FloatArray, block: int | None
) -> Considered:
    """What there is to say of the considered parameters of a fit that ended at `theta` (n,), by the
    scores of blocks of `block` samples where innovations are coloured (else None)."""
    if not options.considered:
        return NOTHING
    fixed = tuple(n for n in options.fixed if n not in options.considered)
    free = None if options.free is None else (*options.free, *options.considered)
    wide = make_problem(problem.dynamics, data, options.but(fixed=fixed, free=free))
    own = {(u.name, u.flight): t for u, t in zip(problem.unknowns, theta, strict=True)}
    base = dict(
        zip((d.name for d in problem.dynamics.parameters), problem.base.tolist(), strict=True)
    )
    at = np.array([own.get((u.name, u.flight), base.get(u.name, u.start)) for u in wide.unknowns])
    places = {(u.name, u.flight): i for i, u in enumerate(wide.unknowns)}
    mine = np.array([places[u.name, u.flight] for u in problem.unknowns], dtype=np.intp)
    others = np.array(
        [i for i, u in enumerate(wide.unknowns) if (u.name, u.flight) not in own], dtype=np.intp
    )
    value = wide.evaluate(at, scores=block)
    if value.hessian is None or value.gradient is None or value.data_hessian is None:
        return Considered(spread=np.zeros((problem.n, problem.n)))
    g = value.gradient[mine]
    loose = ~(((theta <= problem.lower) & (g > 0)) | ((theta >= problem.upper) & (g < 0)))
    moves = np.zeros((problem.n, others.size))
    inverse, _ = scaled_inverse(value.hessian[np.ix_(mine[loose], mine[loose])])
    moves[loose] = -inverse @ value.hessian[np.ix_(mine[loose], others)]
    sigma = np.array([wide.unknowns[i].sigma for i in others])
    scores = None if block is None else value.scores
    error = by_flights_alone(value.data_hessian, mine[loose], others, sigma, scores)
    return Considered(
        spread=(moves * sigma**2) @ moves.T,
        moves={
            wide.unknowns[i].name: (float(s), column)
            for i, s, column in zip(others, sigma, moves.T, strict=True)
            if wide.unknowns[i].flight is None
        },
        told={
            wide.unknowns[i].name: (float(e), float(s))
            for i, e, s in zip(others, error, sigma, strict=True)
            if e < s and wide.unknowns[i].flight is None
        },
    )


def by_flights_alone(
    hessian: FloatArray,
    unknown: Places,
    held: Places,
    sigma: FloatArray,
    scores: FloatArray | None = None,
) -> FloatArray:
    """Standard error (n_c,) of every held parameter by the data's Hessian (n, n), the other held
    ones known to `sigma` (n_c,); infinite where the flights say nothing, or not more than rounding.
    With the `scores` (n_b, n) of blocks no less than their scatter says."""
    moves, shown, rough = _eliminated(hessian, unknown, held)
    errors = np.full(held.size, np.inf)
    blocks = np.zeros((0, held.size))
    if scores is not None:
        blocks = scores[:, held] - scores[:, unknown] @ moves.T
        if len(blocks) < FEWEST_BLOCKS:
            return errors
    for i in range(held.size):
        rest = np.delete(np.arange(held.size), i)
        others = shown[np.ix_(rest, rest)] + np.diag(sigma[rest] ** -2.0)
        share = np.linalg.solve(others, shown[rest, i])
        alone = shown[i, i] - shown[i, rest] @ share
        if alone > (rough[i] + np.abs(share) @ rough[rest]) ** 2:
            own = blocks[:, i] - blocks[:, rest] @ share
            scatter = len(own) * float(own.var(ddof=1)) if own.size else 0.0
            scatter += float(((share / sigma[rest]) ** 2).sum()) if own.size else 0.0
            errors[i] = max(alone**-0.5, scatter**0.5 / alone)
    return errors


def _eliminated(
    hessian: FloatArray, unknown: Places, held: Places
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(by how much the unknowns follow the held parameters (n_c, n_u), what is then left of their
    information (n_c, n_c), the square root of its rounding (n_c,)).

    What is left is a minimum over how the unknowns follow: an error there counts by its square, so
    that no condition number enters, only that of the Hessian's entries (Higham 2002, Accuracy and
    Stability of Numerical Algorithms, sec. 10.3). Directions below rounding may hold all they can.
    """
    inner, cross = hessian[np.ix_(unknown, unknown)], hessian[np.ix_(held, unknown)]
    whole = hessian[np.ix_(held, held)]
    own = np.sqrt(np.maximum(np.diag(whole), 0.0))
    if not unknown.size:
        return cross, whole, ROUNDING**0.5 * own
    size, level, vector = scaled_eigen(inner)
    least = size.size * ROUNDING * level[-1]
    good = level > least
    along = cross / size @ vector
    moves = (along[:, good] / level[good]) @ vector[:, good].T / size
    shown = whole - cross @ moves.T - moves @ cross.T + moves @ inner @ moves.T
    rough = ROUNDING**0.5 * (own + np.abs(moves) @ size)
    return moves, shown, rough + np.sqrt((along[:, ~good] ** 2).sum(axis=1) / least)
