"""The structured secant of Dennis, Gay and Welsch (1981): the part of the Hessian that Gauss-Newton
leaves out."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from greybox.estimation.problem import Value
from greybox.estimation.solvers.curvature import Curvature, definite, with_secant
from greybox.estimation.solvers.levenberg_marquardt import LevenbergMarquardt
from greybox.symbolic import FloatArray

SIZE = 4


def matrix(seed: int) -> FloatArray:
    """A positive definite matrix."""
    root = np.random.default_rng(seed).normal(size=(SIZE, SIZE))
    return root @ root.T + np.eye(SIZE)


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**31))
def test_the_secant_equation_holds_and_symmetry_stays(seed: int) -> None:
    rng = np.random.default_rng(seed)
    plain, true, missing = matrix(seed), matrix(seed + 1), matrix(seed + 2) - matrix(seed + 3)
    step = rng.normal(size=SIZE)
    change = true @ step
    found = with_secant(missing, step, change, plain)
    np.testing.assert_allclose(found, found.T, atol=1e-9 * np.abs(found).max())
    np.testing.assert_allclose(
        (plain + found) @ step, change, rtol=1e-7, atol=1e-7 * np.abs(change).max()
    )


def test_a_gradient_that_falls_along_the_step_teaches_nothing() -> None:
    missing, step = matrix(1), np.ones(SIZE)
    np.testing.assert_array_equal(with_secant(missing, step, -step, matrix(2)), missing)


def test_what_is_not_definite_is_not_used() -> None:
    assert definite(np.diag([1.0, 1e-8]))
    assert not definite(np.diag([1.0, -1e-8]))
    assert not definite(np.array([[1.0, 2.0], [2.0, 1.0]]))


def test_where_gauss_newton_is_right_it_is_used() -> None:
    """On a quadratic whose Hessian is known nothing else is ever trusted."""
    h = matrix(5)
    curvature, x = Curvature(SIZE), np.ones(SIZE)
    for _ in range(5):
        value = Value(cost=0.5 * float(x @ h @ x), likelihood=0.0, gradient=h @ x, hessian=h)
        assert curvature.at(x, value) is h
        x = 0.5 * x


class Quadratic:
    """cost = x' H x / 2 of which the solver is told another Hessian; `asked` counts evaluations."""

    def __init__(self, true: FloatArray, told: FloatArray) -> None:
        from types import SimpleNamespace

        self.true, self.told, self.asked = true, told, 0
        self.unknowns = tuple(SimpleNamespace(kind="parameter", origin=np.nan) for _ in range(SIZE))
        self.lower, self.upper = np.full(SIZE, -1e9), np.full(SIZE, 1e9)

    def evaluate(self, x: FloatArray, order: int = 2) -> Value:
        self.asked += 1
        cost = 0.5 * float(x @ self.true @ x)
        return Value(cost=cost, likelihood=cost, gradient=self.true @ x, hessian=self.told.copy())


@pytest.mark.parametrize("seed", range(8))
def test_a_wrong_hessian_is_mended_on_the_way(seed: int) -> None:
    """Ten times too large here, and too small there by a third: the optimum is reached to rounding
    in a few steps."""
    true = matrix(seed)
    own = np.linalg.cholesky(true)
    told = own @ np.diag([10.0, 0.7, 3.0, 1.0]) @ own.T
    problem = Quadratic(true, told)
    x, status = LevenbergMarquardt(tolerance=1e-10).solve(problem, np.full(SIZE, 5.0))  # type: ignore[arg-type]
    assert status.converged
    assert status.iterations < 25
    assert problem.evaluate(x).cost < 1e-8
