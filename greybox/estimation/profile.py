"""Profile likelihood of one unknown: the others re-optimised along a grid, and the likelihood-ratio
interval.

    interval = { v : 2 (V(v) - V_min) <= c chi2_1(level) },   V(v) = min over the other unknowns of the cost

(Venzon and Moolgavkar 1988, Applied Statistics 37(1); Raue et al. 2009, Bioinformatics 25(15).)
Where the cost is not quadratic in the unknown this interval is right and the symmetric one is not;
a flat profile is an unknown that the data do not identify. Priors are part of the cost. Where the
likelihood is too sure, as with coloured innovations, c is the variance that the unknown has over
that which the likelihood gives it (Kent 1982, Biometrika 69(1)), else 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.interpolate

from greybox.errors import UnknownNameError
from greybox.estimation.problem import Problem, Unknown, Value
from greybox.estimation.solved import solved
from greybox.estimation.solver import Solver
from greybox.plots import Curve, panels
from greybox.shown import Cell, Shown
from greybox.statistics.distributions import chi_square_quantile
from greybox.symbolic import BoolArray, FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True, kw_only=True, eq=False)
class Slice:
    """A problem with one unknown held at a value: what solvers see of a problem, with n - 1
    unknowns."""

    problem: Problem
    place: int
    value: float

    def _keep(self, v: FloatArray) -> FloatArray:
        return np.delete(v, self.place)

    def full(self, theta: FloatArray) -> FloatArray:
        """All unknowns (n,)."""
        return np.insert(theta, self.place, self.value)

    @property
    def n(self) -> int:
        """Number of unknowns left."""
        return self.problem.n - 1

    @property
    def unknowns(self) -> tuple[Unknown, ...]:
        """Unknowns left."""
        return self.problem.unknowns[: self.place] + self.problem.unknowns[self.place + 1 :]

    @property
    def start(self) -> FloatArray:
        """Start values."""
        return self._keep(self.problem.start)

    @property
    def lower(self) -> FloatArray:
        """Lower bounds."""
        return self._keep(self.problem.lower)

    @property
    def upper(self) -> FloatArray:
        """Upper bounds."""
        return self._keep(self.problem.upper)

    @property
    def scale(self) -> FloatArray:
        """Typical sizes."""
        return self._keep(self.problem.scale)

    def evaluate(self, theta: FloatArray, order: int = 1, scores: int | None = None) -> Value:
        """Cost on the slice; derivatives in the unknowns that are left."""
        value = self.problem.evaluate(self.full(theta), order, scores)
        if value.gradient is None or value.hessian is None:
            return value
        hessian = np.delete(np.delete(value.hessian, self.place, 0), self.place, 1)
        return Value(
            cost=value.cost,
            likelihood=value.likelihood,
            gradient=self._keep(value.gradient),
            hessian=hessian,
            valid=value.valid,
        )


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Profile(Shown):
    """Profile of one unknown: grid (m,) in its unit (levels, not logarithms, of noise), cost (m,),
    converged (m,).

    `lower` and `upper` end the likelihood-ratio interval at `level`; an end is the bound where the
    profile reaches it first, and infinite where the grid ended before the cost had risen enough
    (not identified on that side). Enough is `limit`.
    """

    name: str
    flight: str | None
    unit: str
    estimate: float
    grid: FloatArray
    cost: FloatArray
    converged: BoolArray
    level: float
    limit: float
    lower: float
    upper: float

    def _shown_text(self) -> str:
        """The estimate and its interval."""
        unit = "" if self.unit in ("", "1") else f" {self.unit}"
        flight = "" if self.flight is None else f" of {self.flight}"
        ends = f"{self.lower:.5g} to {self.upper:.5g}{unit}"
        failed = int((~self.converged).sum())
        lines = [
            f"{self.name}{flight} = {self.estimate:.5g}{unit}, {self.level:.0%} interval {ends}"
        ]
        lines += (
            [f"warning: {failed} of {self.grid.size} points did not converge"] if failed else []
        )
        return "\n".join([*lines, f"profile likelihood at {self.grid.size} points"])

    def _shown_rows(self) -> list[dict[str, Cell]]:
        """One row per point: value, cost above the least, whether the others converged."""
        least = float(np.nanmin(self.cost))
        return [
            {self.name: float(v), "cost above the least": float(c) - least, "converged": bool(ok)}
            for v, c, ok in zip(self.grid, self.cost, self.converged, strict=True)
        ]

    def plot(self, ax: Axes | None = None) -> Axes:
        """The cost above its least along the profile; matplotlib axes."""
        unit = "" if self.unit in ("", "1") else f" [{self.unit}]"
        curve = Curve(label="", x=self.grid, y=self.cost - float(np.nanmin(self.cost)))
        rows = {"cost above the least": [curve]}
        return panels(rows, x=f"{self.name}{unit}", ax=None if ax is None else [ax])[0]


def _place(problem: Problem, name: str, flight: str | None) -> int:
    """Where the unknown stands. Raises `UnknownNameError` for a name that is none, a flight that
    is not there, and none where each has its own value."""
    owners = [u.flight for u in problem.unknowns if u.name == name and u.flight is not None]
    if flight is not None and flight not in {*problem.flights, *owners}:
        raise UnknownNameError("flight", flight, owners or problem.flights)
    place = problem.place(name, flight)
    if place is not None:
        return place
    if owners:
        fix = f"it has a value for every flight; name one of {', '.join(owners)}"
        raise UnknownNameError("number of all flights", name, (), fix=fix)
    raise UnknownNameError("estimated number", name, {u.name for u in problem.unknowns})


def profile(
    problem: Problem,
    solver: Solver,
    theta: FloatArray,
    name: str,
    *,
    flight: str | None = None,
    grid: Sequence[float] | None = None,
    points: int = 6,
    width: float = 3.0,
    level: float = 0.95,
    error: float = 0.0,
) -> Profile:
    """Profile of the unknown `name` around the optimum `theta` (n,), whose standard `error` (of a
    noise level in its logarithm) is known to be larger than the likelihood says, or may be.

    `grid` gives the values (in the unknown's unit); without it `points` values to either side,
    `width` standard errors apart at the end, and further ones while the cost has not risen enough.
    Each point starts from its neighbour. Raises `UnknownNameError` for a name that is no unknown.
    """
    place = _place(problem, name, flight)
    u = problem.unknowns[place]
    logarithmic = u.kind == "noise"
    best = problem.evaluate(theta)
    own = _standard_error(best, place, u.scale)
    wider = max(error / own, 1.0) if np.isfinite(error) else 1.0
    threshold = 0.5 * float(chi_square_quantile(level, 1)) * wider**2
    centre = float(theta[place])
    walk = _Walk(problem, solver, place, {centre: (best.cost, True)})
    if grid is not None:
        given = np.asarray(grid, dtype=np.float64)
        walk.over(theta, np.log(given) if logarithmic else given)
    else:
        step = width * wider * own / points
        for sign, end in ((1.0, u.upper), (-1.0, u.lower)):
            walk.out(theta, sign * step, end, threshold, points)
    found = walk.found
    values = np.array(sorted(found))
    cost = np.array([found[v][0] for v in values])
    lower, upper = (_crossing(values, cost, centre, best.cost + threshold, s, u) for s in (-1, 1))
    as_unit = np.exp if logarithmic else np.asarray
    return Profile(
        name=name,
        flight=u.flight,
        unit=u.unit,
        estimate=float(as_unit(centre)),
        grid=np.asarray(as_unit(values)),
        cost=cost,
        converged=np.array([found[v][1] for v in values]),
        level=level,
        limit=threshold,
        lower=float(as_unit(lower)),
        upper=float(as_unit(upper)),
    )


@dataclass(frozen=True)
class _Walk:
    """Along the unknown at `place`: what was `found` at every value, cost and whether the others
    converged there. Each point starts from its neighbour."""

    problem: Problem
    solver: Solver
    place: int
    found: dict[float, tuple[float, bool]]

    def _solve(self, value: float, near: FloatArray) -> FloatArray:
        part = Slice(problem=self.problem, place=self.place, value=value)
        estimate, status = solved(part, self.solver, near)
        self.found[value] = (part.evaluate(estimate, 0).cost, bool(status.converged))
        return np.asarray(estimate)

    def over(self, theta: FloatArray, wanted: FloatArray) -> None:
        """Over the `wanted` values, to either side of the optimum `theta` (n,)."""
        centre = float(theta[self.place])
        for side in (np.sort(wanted[wanted > centre]), np.sort(wanted[wanted < centre])[::-1]):
            near = np.delete(theta, self.place)
            for v in side:
                near = self._solve(float(v), near)

    def out(self, theta: FloatArray, step: float, end: float, enough: float, points: int) -> None:
        """From the optimum to one side, `points` steps and further, longer ones, until the cost
        has risen `enough` or `end` is reached."""
        sign, size = float(np.sign(step)), abs(step)
        near, value = np.delete(theta, self.place), float(theta[self.place])
        least = self.found[value][0]
        for count in range(3 * points):
            if (end - value) * sign <= 0:
                break
            value = value + sign * size
            value = end if (end - value) * sign < 0.1 * size else value
            near = self._solve(value, near)
            if self.found[value][0] - least > enough and count + 1 >= min(points, 3):
                break
            size = size if count < points else 2 * size


def _standard_error(value: Value, place: int, scale: float) -> float:
    """Of one unknown, the others free; its scale where the Hessian does not tell."""
    assert value.hessian is not None
    size = np.sqrt(np.maximum(np.diag(value.hessian), 1e-300))
    inverse = np.linalg.pinv(value.hessian / np.outer(size, size), hermitian=True, rcond=1e-12)
    error = float(np.sqrt(max(inverse[place, place], 0.0)) / size[place])
    return error if np.isfinite(error) and error > 0 else scale


def _crossing(
    values: FloatArray, cost: FloatArray, centre: float, limit: float, side: int, u: Unknown
) -> float:
    """Where the profile first exceeds `limit` on one side, by monotone interpolation of the root of
    its rise."""
    chosen = values >= centre if side > 0 else values <= centre
    v, c = values[chosen], cost[chosen]
    order = np.argsort(side * v)
    v, c = v[order], c[order]
    above = np.flatnonzero(c > limit)
    if not above.size:
        end = u.upper if side > 0 else u.lower
        return (
            end
            if np.isfinite(end) and abs(v[-1] - end) <= 1e-12 * max(abs(end), 1e-300)
            else side * np.inf
        )
    stop = int(above[0]) + 1
    rise = np.maximum.accumulate(np.sqrt(np.maximum(c[:stop] - cost[values == centre][0], 0.0)))
    rise = rise + 1e-12 * np.arange(stop)
    at = np.sqrt(limit - float(cost[values == centre][0]))
    return float(scipy.interpolate.PchipInterpolator(rise, v[:stop])(at))
