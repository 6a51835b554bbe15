"""A delay of whole samples makes a kink of the cost. A minimum there is found, is one, and does not
stop the search for all other unknowns."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from greybox.estimation.problem import Value
from greybox.estimation.solvers.kink import kink_near
from greybox.estimation.solvers.levenberg_marquardt import LevenbergMarquardt
from greybox.estimation.status import Code
from greybox.symbolic import FloatArray


class Kinked:
    """50 (x + y - 1)^2 + 50 (x - y)^2 + slope |y - place|: at a kink in y where the slope is
    steep."""

    n = 2
    scale = np.ones(2)
    lower, upper = np.full(2, -10.0), np.full(2, 10.0)
    unknowns = tuple(SimpleNamespace(kind="parameter", origin=np.nan) for _ in range(2))

    def __init__(self, slope: float, place: float) -> None:
        self.slope, self.place = slope, place

    def evaluate(self, x: FloatArray, order: int = 1, scores: int | None = None) -> Value:
        a, b = x[0] + x[1] - 1.0, x[0] - x[1]
        side = 1.0 if x[1] >= self.place else -1.0
        cost = 50 * a**2 + 50 * b**2 + self.slope * abs(x[1] - self.place)
        gradient = np.array([100 * (a + b), 100 * (a - b) + self.slope * side])
        hessian = np.array([[200.0, 0.0], [0.0, 200.0]])
        return Value(cost=cost, likelihood=cost, gradient=gradient, hessian=hessian)


@pytest.mark.parametrize("place", [0.3, 0.62])
@pytest.mark.parametrize("start", [(3.0, -2.0), (0.0, 4.0)])
def test_a_steep_kink_holds_its_unknown_and_the_rest_arrives(
    place: float, start: tuple[float, float]
) -> None:
    found, status = LevenbergMarquardt().solve(Kinked(80.0, place), np.array(start))
    assert status.code is Code.CONVERGED
    assert found == pytest.approx([0.5, place], abs=1e-3)


def test_a_kink_elsewhere_is_no_minimum() -> None:
    found, status = LevenbergMarquardt().solve(Kinked(4.0, 3.0), np.array([0.0, 0.0]))
    assert status.code is Code.CONVERGED
    assert found == pytest.approx([0.5, 0.52], abs=1e-4)


class Clamped(Kinked):
    """5e3 (x - 1)^2 + y^2 / 18, and a steep rise where x + y > 0: a sum that is felt on one side
    only, as that of two delays where no reading comes before its command."""

    def evaluate(self, x: FloatArray, order: int = 1, scores: int | None = None) -> Value:
        off, felt = x[0] + x[1], float(x[0] + x[1] > 0)
        cost = 5e3 * (x[0] - 1.0) ** 2 + x[1] ** 2 / 18 + felt * (self.slope * off + 5e3 * off**2)
        push = felt * (self.slope + 1e4 * off)
        gradient = np.array([1e4 * (x[0] - 1.0) + push, x[1] / 9 + push])
        hessian = np.diag([1e4, 1 / 9]) + felt * 1e4
        return Value(cost=cost, likelihood=cost, gradient=gradient, hessian=hessian)


@pytest.mark.parametrize("start", [(0.2, -0.1), (2.0, -1.5), (0.5, -3.0)])
@pytest.mark.parametrize("tolerance", [1e-6, 1e-2])
def test_along_a_kink_of_two_unknowns_the_search_goes_on(
    start: tuple[float, float], tolerance: float
) -> None:
    """The least on x + y = 0, to which the weak slope in y leads from below."""
    rule = LevenbergMarquardt(tolerance=tolerance)
    found, status = rule.solve(Clamped(1e4, 0.0), np.array(start))
    assert status.code is Code.CONVERGED
    assert status.iterations < 20
    assert found == pytest.approx([1.0, -1.0], abs=2e-2)


def test_where_the_cost_falls_on_two_costs_say_that_no_kink_is_near() -> None:
    problem, x = Kinked(0.0, 3.0), np.zeros(2)
    value, asked = problem.evaluate(x), list[FloatArray]()
    problem.evaluate = lambda x, *_, **__: asked.append(x) or Kinked.evaluate(problem, x)  # type: ignore[method-assign,func-returns-value]
    assert value.gradient is not None and value.hessian is not None
    step = -np.linalg.solve(value.hessian, value.gradient)
    found, tried = kink_near(problem, x, value, step, value.hessian, np.zeros(2, dtype=bool))
    assert found is None
    assert tried == len(asked) == 2
