"""A formula over many samples gives what CasADi gives, instruction by instruction."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from greybox.frames import _function
from greybox.instructions import CALLS, FEWEST, PIECE, carried_out
from greybox.symbolic import evaluate

FORMULAS = (
    "rotate",
    "rotate_inverse",
    "difference",
    "matrix",
    "multiply",
    "exp",
    "log",
    "euler",
    "from_euler",
)


def drawn(function: ca.Function, n: int) -> list[np.ndarray]:
    """Numbers of both signs, some of them zero, and a sample that is missing."""
    rng = np.random.default_rng(7)
    columns = [rng.normal(size=(n, function.numel_in(i))) for i in range(function.n_in())]
    for c in columns:
        c[::11] = 0.0
        c[3] = np.nan
    return columns


def alone(function: ca.Function, columns: list[np.ndarray]) -> np.ndarray:
    """Every sample by itself, in CasADi."""
    rows = zip(*columns, strict=True)
    return np.array([np.asarray(function(*row)).ravel() for row in rows])


@pytest.mark.parametrize("name", FORMULAS)
def test_every_formula_of_rotations(name):
    function = _function(name)
    columns = drawn(function, PIECE + 5)
    out = np.zeros((PIECE + 5, function.numel_out(0)))
    assert carried_out(function, columns, out)
    np.testing.assert_allclose(out, alone(function, columns), rtol=1e-13, atol=1e-15)
    np.testing.assert_array_equal(evaluate(function, *columns), out)


def test_every_instruction_that_is_known():
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    # A difference of comparisons: truth is a number here, as in CasADi.
    terms = [x + y, x - y, x * y, x / y, -x, x + x, x * x, ca.sqrt(ca.fabs(x))]
    terms += [ca.sin(x), ca.cos(y), ca.asin(x / 9), ca.acos(x / 9), ca.atan2(x, y)]
    terms += [ca.fmin(x, y), ca.fmax(x, y)]
    terms += [(x < y) - (y <= 0.5), ca.if_else(ca.logic_not(x < y), x, y)]
    function = ca.Function("f", [x, y], [ca.vertcat(*terms, 3.0)])
    used = {function.instruction_id(k) for k in range(function.n_instructions())}
    assert set(CALLS) <= used
    columns = drawn(function, FEWEST)
    found, expected = evaluate(function, *columns), alone(function, columns)
    known = np.isfinite(columns[0]).ravel()
    np.testing.assert_allclose(found[known], expected[known], rtol=1e-13, atol=1e-15)


def test_a_function_with_another_instruction_is_left_to_casadi():
    x = ca.SX.sym("x", 2)
    function = ca.Function("f", [x], [ca.tanh(x)])
    columns = drawn(function, FEWEST)
    assert not carried_out(function, columns, np.zeros((FEWEST, 2)))
    np.testing.assert_allclose(evaluate(function, *columns), np.tanh(columns[0]), rtol=1e-14)
