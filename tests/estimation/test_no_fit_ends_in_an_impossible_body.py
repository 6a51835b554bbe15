"""From whatever start, a fit of a vehicle file of schema /2 goes through bodies that can be, and
ends in one.

The simulated craft helps: its stated moments (1.43e-5, 1.43e-5, 2.89e-5 kg m^2) break the triangle
inequality by one per cent, as those of rounded tables do, so that the data pull every fit of it
towards the wall and across.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.optimize

from greybox.estimation.conclusion import concluded
from greybox.estimation.criteria import CRITERIA
from greybox.estimation.feasible import NEAR, Body, moved_inside, wall
from greybox.estimation.multistart import random_start
from greybox.estimation.options import FitOptions
from greybox.estimation.predictors import PREDICTORS
from greybox.estimation.problem import Value, make_problem
from greybox.estimation.solvers import SOLVERS
from greybox.estimation.solvers.levenberg_marquardt import LevenbergMarquardt
from greybox.model.body import is_possible, margins
from greybox.model.model import build_model
from greybox.model.vehicle import Vehicle, read_vehicle
from greybox.model.vehicle_parts import EXACT_SCHEMA
from greybox.plants.vehicle_file import write_vehicle
from tests.simulated import flights, plant

EFFECTS = ("motor_lag", "products_of_inertia")
SIX = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
BODY = Body(held=np.zeros((3, 3)), columns=tuple(range(6)), elements=SIX)
PLAIN = Body(held=np.zeros((3, 3)), columns=(0, 1, 2), elements=SIX[:3])


@pytest.fixture(scope="module")
def stranger(tmp_path_factory) -> Vehicle:
    """The vehicle file of a stranger: no sigma anywhere."""
    path = tmp_path_factory.mktemp("vehicle") / "v.toml"
    return read_vehicle(
        write_vehicle(path, plant(), errors={"inertia": 1.1}, schema="greybox.vehicle/2")
    )


@cache
def short_flight():
    return flights(1, 4.0)


def problem_of(vehicle: Vehicle, effects=EFFECTS, **options):
    model = build_model(vehicle, short_flight().channels, effects, sample_time=0.01)
    return make_problem(
        model,
        short_flight(),
        predictor=PREDICTORS["innovation"](),
        criterion=CRITERIA["gaussian"](),
        **options,
    )


def from_bodies(rng: np.random.Generator) -> np.ndarray:
    """Inertia matrix of random points of mass."""
    points = rng.standard_normal((3, 6)) * rng.uniform(0.1, 1.0, (3, 1))
    second = points @ points.T
    return np.trace(second) * np.eye(3) - second


def test_every_body_of_points_is_possible_and_a_longer_axis_than_the_others_together_is_not():
    rng = np.random.default_rng(1)
    assert all(is_possible(from_bodies(rng)) for _ in range(200))
    assert not is_possible(np.diag([1.0, 1.0, 2.001]))
    assert not is_possible(np.diag([1.0, 1.0, -0.1]))
    assert not is_possible(np.array([[1.0, 0.9, 0.0], [0.9, 1.0, 0.0], [0.0, 0.0, 1.0]]))
    np.testing.assert_allclose(margins(np.eye(3)), 1 / 6)


def pseudo_inertia(mass: float, centre: np.ndarray, inertia: np.ndarray) -> np.ndarray:
    """Mass, first and second moments (4, 4) about the origin of body axes, of an inertia about the
    centre of mass."""
    second = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    first = mass * centre[:, None]
    return np.block([[second + first @ centre[None], first], [first.T, np.array([[mass]])]])


def test_a_body_is_possible_exactly_where_its_pseudo_inertia_is_positive_definite():
    """So that mass above zero and the wall admit all that log-Cholesky coordinates reach, and
    nothing else."""
    rng, found = np.random.default_rng(7), []
    for _ in range(1000):
        turned = np.linalg.qr(rng.standard_normal((3, 3)))[0]
        second = turned @ np.diag(rng.uniform(-0.2, 1.0, 3)) @ turned.T
        inertia = np.trace(second) * np.eye(3) - second
        mass = rng.choice([-1.0, 1.0, 1.0]) * rng.uniform(0.1, 2.0)
        whole = np.linalg.eigvalsh(pseudo_inertia(mass, rng.standard_normal(3), inertia))
        found.append(bool(whole[0] > 0))
        assert found[-1] == (mass > 0 and is_possible(inertia))
    assert 200 < sum(found) < 800


def test_the_wall_is_felt_only_near_it_and_its_slope_is_that_of_its_height():
    far = np.array([1.0, 1.0, 1.9, 0.0, 0.0, 0.0])
    assert wall([BODY], far).cost == 0.0 and not wall([BODY], far).gradient.any()
    assert wall([BODY], np.array([1.0, 1.0, 2.1, 0, 0, 0])).cost == np.inf
    near = np.array([1.0, 1.1, 2.06, 0.02, -0.03, 0.01])
    at = wall([BODY], near)
    steps = 1e-6 * np.eye(6)
    slopes = [(wall([BODY], near + s).cost - wall([BODY], near - s).cost) / 2e-6 for s in steps]
    np.testing.assert_allclose(at.gradient, slopes, rtol=1e-6, atol=1e-7)
    assert at.cost > 0 and np.linalg.eigvalsh(at.hessian)[0] > -1e-9
    assert margins(BODY.inertia(near))[-1] < NEAR


@pytest.mark.parametrize("held", [(), (0,), (0, 1), (2,), (3, 4, 5)])
def test_a_thousand_random_starts_are_moved_inside_by_what_is_free(held):
    rng = np.random.default_rng(2)
    body = Body(
        held=np.diag([1.0 if i in held else 0.0 for i in range(3)]),
        columns=tuple(range(6 - len(held))),
        elements=tuple(e for i, e in enumerate(SIX) if i not in held),
    )
    n = len(body.columns)
    diagonal = np.array([i == j for i, j in body.elements])
    lower, upper = np.where(diagonal, 0.05, -0.25), np.where(diagonal, 20.0, 0.25)
    for _ in range(1000):
        start = (
            rng.uniform(lower, upper)
            if rng.uniform() < 0.5
            else lower * (np.abs(upper / lower) ** rng.uniform(size=n))
        )
        moved = moved_inside([body], start, lower, upper)
        assert is_possible(body.inertia(moved))
        assert (moved >= lower).all() and (moved <= upper).all()
        if is_possible(body.inertia(start)):
            np.testing.assert_array_equal(moved, np.clip(start, lower, upper))


@dataclass
class Pulled:
    """A quadratic cost whose minimum is a body that cannot be."""

    body: Body
    goal: np.ndarray
    weight: np.ndarray
    lower: np.ndarray
    upper: np.ndarray

    @property
    def unknowns(self):
        return [SimpleNamespace(kind="parameter", name="inertia", origin=np.nan) for _ in self.goal]

    def inside(self, theta):
        return moved_inside([self.body], theta, self.lower, self.upper)

    def evaluate(self, theta, order=1, scores=None):
        limit = wall([self.body], theta)
        off = theta - self.goal
        cost = 0.5 * float(off @ self.weight @ off) + limit.cost
        if not np.isfinite(cost):
            return Value(cost=np.inf, likelihood=np.inf, valid=False)
        gradient, hessian = self.weight @ off + limit.gradient, self.weight + limit.hessian
        return Value(cost=cost, likelihood=cost, gradient=gradient, hessian=hessian)


def pulled(body: Body) -> Pulled:
    """Moments of 1.0, 0.8 and 2.6, wanted with standard deviations of about one per cent."""
    n = len(body.columns)
    mixed = np.random.default_rng(3).standard_normal((n, n))
    return Pulled(
        body=body,
        goal=np.array([1.0, 0.8, 2.6, 0.1, 0.0, -0.1])[:n],
        weight=1e3 * (mixed @ mixed.T + np.eye(n)),
        lower=np.array([0.05, 0.05, 0.05, -1, -1, -1.0])[:n],
        upper=np.array([20, 20, 20, 1, 1, 1.0])[:n],
    )


@pytest.mark.parametrize("count", [40, pytest.param(200, marks=pytest.mark.slow)])
def test_searches_that_are_pulled_across_end_inside_and_at_one_place(count):
    problem, rng, costs = pulled(PLAIN), np.random.default_rng(5), []
    for _ in range(count):
        theta, status = LevenbergMarquardt().solve(
            problem, problem.inside(rng.uniform(problem.lower, 4.0))
        )
        assert status.converged and is_possible(PLAIN.inertia(theta))
        costs.append(problem.evaluate(theta, 0).cost)
    assert np.ptp(costs) < 1e-4


@pytest.mark.parametrize("count", [10, pytest.param(50, marks=pytest.mark.slow)])
def test_searches_with_products_of_inertia_end_inside_too(count):
    problem, rng = pulled(BODY), np.random.default_rng(6)
    for _ in range(count):
        start = problem.inside(rng.uniform(problem.lower, [4, 4, 4, 1, 1, 1]))
        theta, _ = LevenbergMarquardt().solve(problem, start)
        assert is_possible(BODY.inertia(theta))


def ends(vehicle: Vehicle, count: int) -> list[bool]:
    """Whether fits from random starts end with a possible body."""
    problem, rng = problem_of(vehicle, ("motor_lag",)), np.random.default_rng(4)
    (body,) = problem.bodies
    out = []
    for _ in range(count):
        theta, _ = LevenbergMarquardt(max_iterations=30).solve(
            problem, random_start(problem, rng, problem.start, 3.0)
        )
        out.append(is_possible(body.inertia(theta)))
    return out


@pytest.mark.slow
def test_five_fits_from_random_starts_end_in_possible_bodies(stranger):
    assert all(ends(stranger, 5))


@pytest.mark.slow
def test_a_thousand_fits_from_random_starts_end_in_possible_bodies(stranger):
    assert ends(stranger, 1000).count(False) == 0


class Watched:
    """A problem that remembers where its cost was finite."""

    def __init__(self, problem):
        self.problem, self.visited = problem, []

    def __getattr__(self, name):
        return getattr(self.problem, name)

    def evaluate(self, theta, order=1, scores=None):
        value = self.problem.evaluate(theta, order, scores)
        if value.valid:
            self.visited.append(theta.copy())
        return value


@pytest.mark.parametrize("name", ["levenberg-marquardt", "gauss-newton", "scipy-trf", "ipopt"])
def test_every_solver_goes_through_bodies_only_with_mass_centre_and_inertia_free(stranger, name):
    problem = Watched(problem_of(stranger))
    (body,) = problem.bodies
    free = ["mass", *(f"center_of_mass.{a}" for a in "xyz")]
    at = [problem.place(n) for n in free]
    assert None not in at and len(body.columns) == 6
    theta, _ = SOLVERS[name](max_iterations=15).solve(problem, problem.start)
    for visited in [*problem.visited, theta]:
        mass, *centre = visited[at]
        size = (
            np.append(np.full(3, stranger.arm_length), 1.0) * mass**0.5
        )  # its eigenvalues without units
        whole = pseudo_inertia(mass, np.array(centre), body.inertia(visited))
        np.linalg.cholesky(whole / np.outer(size, size))  # raises unless it is positive definite
    assert len(problem.visited) > 5


def test_log_cholesky_coordinates_find_the_same_body_and_without_a_wall_one_without_thickness():
    problem, box = pulled(PLAIN), np.ones((3, 3)) - np.eye(3)

    def thickness(walled: bool) -> tuple[float, float]:
        """Cost, and smallest second moment over the trace, where a search in logarithms of second
        moments ends."""

        def cost(logs):
            theta = box @ np.exp(logs)
            off = theta - problem.goal
            value = problem.evaluate(theta)
            plain = 0.5 * float(off @ problem.weight @ off), problem.weight @ off
            level, slope = (value.cost, value.gradient) if walled else plain
            return level, (box @ slope) * np.exp(logs)

        found = scipy.optimize.minimize(
            cost, np.log([1.0, 1.0, 0.5]), jac=True, options={"maxiter": 1000}
        )
        return found.fun, float(margins(np.diag(box @ np.exp(found.x)))[-1])

    here, _ = LevenbergMarquardt().solve(problem, problem.inside(np.ones(3)))
    level, thick = thickness(walled=True)
    assert level == pytest.approx(problem.evaluate(here, 0).cost, abs=1e-3)
    assert thick == pytest.approx(margins(PLAIN.inertia(here))[-1], rel=0.02)
    assert thickness(walled=False)[1] < 0.01 * thick


def test_stated_moments_of_a_rounded_table_are_moved_inside_before_the_fit(stranger):
    rounded = replace(stranger, inertia=tuple(map(tuple, np.diag([1.43e-5, 1.43e-5, 2.89e-5]))))
    problem = problem_of(rounded)
    (body,) = problem.bodies
    assert not is_possible(np.array(rounded.inertia))
    assert is_possible(body.inertia(problem.start))
    assert problem.evaluate(problem.start, 0).valid


def test_what_is_held_is_left_as_it_is(stranger):
    rounded = replace(stranger, inertia=tuple(map(tuple, np.diag([1.43e-5, 1.43e-5, 2.89e-5]))))
    fixed = ("inertia.xx", "inertia.yy", "inertia.zz", "products_of_inertia.Jxy")
    problem = problem_of(
        rounded, fixed=(*fixed, "products_of_inertia.Jxz", "products_of_inertia.Jyz")
    )
    assert problem.bodies == () and problem.evaluate(problem.start, 0).valid


def test_files_of_schema_one_keep_their_bounds_and_know_no_wall(stranger):
    old = replace(stranger, schema=EXACT_SCHEMA)
    problem = problem_of(old)
    assert problem.bodies == ()
    declared = {d.name: d for d in problem.dynamics.parameters}
    sigma = old.quantities["thrust.c2"].sigma
    assert declared["thrust.c2"].upper == pytest.approx(
        old.quantities["thrust.c2"].value + 4 * sigma
    )
    new = {d.name: d for d in problem_of(stranger).dynamics.parameters}
    assert new["inertia.zz"].upper == pytest.approx(20 * stranger.inertia[2][2])
    assert new["mass"].lower == pytest.approx(stranger.mass.value / 20)


def test_an_error_bar_at_the_wall_is_that_of_the_flights_and_not_of_the_wall(stranger):
    problem = problem_of(stranger, ("motor_lag",))
    theta, status = LevenbergMarquardt().solve(problem, problem.start)
    found = concluded(problem, short_flight(), FitOptions(), theta, status, 0.0)
    limit = wall(problem.bodies, theta).hessian
    place = problem.place("inertia.zz")
    assert limit[place, place] > 0, "the fit ends where the wall is felt"
    hessian = problem.evaluate(theta).hessian
    with_wall, without = (np.linalg.inv(h)[place, place] ** 0.5 for h in (hessian, hessian - limit))
    assert found.parameters["inertia.zz"].std > 0.97 * without > with_wall
