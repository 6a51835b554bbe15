"""Feasible: which moments of inertia a body can have, as a wall around them that solvers feel and
starts are moved inside.

A body of positive density has second moments of mass that are positive in every direction. In terms
of the inertia matrix J about the centre of mass: every principal moment is below half of their sum,
which is the triangle inequality and makes J positive definite (Wensing, Kim and Slotine 2018,
Linear matrix inequalities for physically consistent inertial parameter identification, IEEE RA-L
3(1), sec. III). The margins below are the second moments over the trace of J; a sphere has 1/6
three times, a flat plate has 0 across.

With a mass above zero this says that the pseudo-inertia matrix, of mass, first and second moments,
is positive definite, wherever the centre of mass lies. Cost is infinite elsewhere, so that every
iterate is a possible body, as in log-Cholesky coordinates (Rucker and Wensing 2022, IEEE RA-L
7(2)). A search in these is not better here: flights that pull across would lead it to a body
without thickness, at infinity and with no error bar, unless the wall stands there too; and a moment
that is held, or has a bound, is none of its coordinates. Draws of bodies are made in them
(`greybox.simulators.coordinates`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from greybox.model.body import PLACES, is_possible, margins
from greybox.model.dynamics import Dynamics
from greybox.model.layer import physics_of
from greybox.model.vehicle_parts import EXACT_SCHEMA
from greybox.symbolic import FloatArray

NEAR = 0.01
"""Margin above which nothing of the wall is felt. Flat quadrotors have 0.02 and more (J / (m L^2)
of 0.24, 0.24, 0.43)."""
WEIGHT = 0.1
"""Height of the wall in units of the cost (negative log posterior) per factor e of margin."""

MOVE, MOST_MOVES = 0.1, 60
"""Share of the way to a sphere that a start is moved at once, and how often; after these 0.2 % of
the way are left."""


class Unknown(Protocol):
    """One scalar of the search space."""

    @property
    def start(self) -> float:
        """Value to start from."""


class Unknowns(Protocol):
    """What the wall needs to know of a problem."""

    @property
    def dynamics(self) -> Dynamics:
        """The model."""

    @property
    def unknowns(self) -> Sequence[Unknown]:
        """The search space, n of them."""

    @property
    def base(self) -> FloatArray:
        """Values of all model parameters where they are no unknowns (n_p,)."""

    @property
    def flights(self) -> tuple[str, ...]:
        """Names of the flights."""

    @property
    def lower(self) -> FloatArray:
        """Lower bounds (n,)."""

    @property
    def upper(self) -> FloatArray:
        """Upper bounds (n,)."""

    def place(self, name: str, flight: str | None = None) -> int | None:
        """Index of an unknown, None where it is fixed."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Body:
    """Inertia matrix of one flight's body as a function of the unknowns: `held` (3, 3) plus the
    unknowns at `columns`, each at the place in the matrix that `elements` says."""

    held: FloatArray
    columns: tuple[int, ...]
    elements: tuple[tuple[int, int], ...]

    def inertia(self, theta: FloatArray) -> FloatArray:
        """J (3, 3) [kg m^2]."""
        out = self.held.copy()
        for at, (i, j) in zip(self.columns, self.elements, strict=True):
            out[i, j] += theta[at]
            if i != j:
                out[j, i] += theta[at]
        return out


@dataclass(frozen=True, kw_only=True, eq=False)
class Wall:
    """The wall at one point: cost, infinite where no body can be, gradient (n,) and positive
    semidefinite Hessian (n, n)."""

    cost: float
    gradient: FloatArray
    hessian: FloatArray


def wall(bodies: Sequence[Body], theta: FloatArray) -> Wall:
    """The wall of all bodies at the unknowns `theta` (n,).

    w = WEIGHT * (-log t - (1 - t) - (1 - t)^2 / 2) with t = margin / NEAR, below t = 1: twice
    differentiable, zero where nothing is near. The Hessian leaves out how eigenvectors turn, as
    Gauss-Newton does.
    """
    n = theta.size
    cost, gradient, hessian = 0.0, np.zeros(n), np.zeros((n, n))
    for body in bodies:
        j = body.inertia(theta)
        if not is_possible(j):
            return Wall(cost=np.inf, gradient=gradient, hessian=hessian)
        moments, axes = np.linalg.eigh(j)
        trace = float(moments.sum())
        for moment, axis in zip(moments, axes.T, strict=True):
            t = (0.5 - moment / trace) / NEAR
            if t >= 1.0:
                continue
            slope = np.zeros(n)
            for at, (a, b) in zip(body.columns, body.elements, strict=True):
                grows = axis[a] * axis[b] * (1.0 if a == b else 2.0)
                slope[at] = (moment / trace * (a == b) - grows) / (trace * NEAR)
            cost += WEIGHT * (-np.log(t) - (1 - t) - 0.5 * (1 - t) ** 2)
            gradient += WEIGHT * (-1 / t + 2 - t) * slope
            hessian += WEIGHT * (1 / t**2 - 1) * np.outer(slope, slope)
    return Wall(cost=float(cost), gradient=gradient, hessian=hessian)


def moved_inside(
    bodies: Sequence[Body], theta: FloatArray, lower: FloatArray, upper: FloatArray
) -> FloatArray:
    """`theta` (n,) within its bounds (n,), and every body moved towards a sphere of the same trace
    until it is possible.

    Bodies with a margin stay as they are. What the unknowns cannot mend (an impossible body that is
    held) stays too.
    """
    out = np.clip(theta, lower, upper)
    for body in bodies:
        j = body.inertia(out)
        if is_possible(j):
            continue
        before = out.copy()
        for _ in range(MOST_MOVES):
            j = body.inertia(out)
            if margins(j)[-1] > 0.5 * NEAR:
                break
            for at, (a, b) in zip(body.columns, body.elements, strict=True):
                goal = np.trace(j) / 3 if a == b else 0.0
                out[at] = min(max(out[at] + MOVE * (goal - j[a, b]), lower[at]), upper[at])
        else:
            out = before
    return np.asarray(out)


def bodies_of(problem: Unknowns) -> tuple[Body, ...]:
    """The bodies whose inertia is estimated, one per set of unknowns (flights may have copies of
    their own).

    None for vehicle files of schema /1, whose fits keep their meaning. Left out are bodies that no
    value of the unknowns makes possible: there the vehicle file holds what no body has, and a wall
    would leave nothing to estimate.
    """
    physics = physics_of(problem.dynamics)
    if physics is None or physics.vehicle.schema == EXACT_SCHEMA:
        return ()
    index = {d.name: i for i, d in enumerate(problem.dynamics.parameters)}
    found: dict[tuple[int | None, ...], Body] = {}
    for flight in problem.flights:
        at = tuple(problem.place(name, flight) for name, _, _ in PLACES)
        if at in found or all(p is None for p in at):
            continue
        held = np.array(physics.vehicle.inertia, dtype=np.float64)
        columns, elements = [], []
        for (name, i, j), place in zip(PLACES, at, strict=True):
            if i == j:
                held[i, i] = 0.0  # the parameter is the element
            if place is not None:
                columns.append(place)
                elements.append((i, j))
            elif name in index:
                value = problem.base[index[name]]
                held[i, j] += value
                held[j, i] += value if i != j else 0.0
        found[at] = Body(held=held, columns=tuple(columns), elements=tuple(elements))
    return tuple(b for b in found.values() if _reachable(b, problem))


def _reachable(body: Body, problem: Unknowns) -> bool:
    theta = np.array([u.start for u in problem.unknowns])
    return is_possible(body.inertia(theta)) or is_possible(
        body.inertia(moved_inside((body,), theta, problem.lower, problem.upper))
    )
