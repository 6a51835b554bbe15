"""A tape run for many samples at once gives what CasADi gives for each of them, whatever the
expression and their number."""

from __future__ import annotations

import ctypes
from functools import cache
from importlib import resources

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from greybox.errors import ModelError
from greybox.estimation.build import DRIVER_FLAGS, build, compiler
from greybox.estimation.tape import CODE, MOST, ORDER, SAMPLES, tape_of

needs_compiler = pytest.mark.skipif(compiler() is None, reason="no C compiler here")
ONE = {
    "NEG": lambda x: -x,
    "SQ": lambda x: x * x,
    "TWICE": lambda x: 2 * x,
    "INV": lambda x: 1 / x,
    "NOT": ca.logic_not,
    "SQRT": ca.sqrt,
    "FABS": ca.fabs,
    "EXP": ca.exp,
    "LOG": ca.log,
    "SIN": ca.sin,
    "COS": ca.cos,
    "TAN": ca.tan,
    "ASIN": ca.asin,
    "ACOS": ca.acos,
    "ATAN": ca.atan,
    "FLOOR": ca.floor,
    "CEIL": ca.ceil,
    "ERF": ca.erf,
    "SINH": ca.sinh,
    "COSH": ca.cosh,
    "TANH": ca.tanh,
    "ASINH": ca.asinh,
    "ACOSH": ca.acosh,
    "ATANH": ca.atanh,
    "LOG1P": ca.log1p,
    "EXPM1": ca.expm1,
    "SIGN": ca.sign,
}
TWO = {
    "ADD": lambda x, y: x + y,
    "SUB": lambda x, y: x - y,
    "MUL": lambda x, y: x * y,
    "DIV": lambda x, y: x / y,
    "LT": ca.lt,
    "LE": ca.le,
    "EQ": ca.eq,
    "NE": ca.ne,
    "AND": ca.logic_and,
    "OR": ca.logic_or,
    "IF_ELSE_ZERO": lambda c, x: ca.if_else(c, x, 0),
    "FMIN": ca.fmin,
    "FMAX": ca.fmax,
    "POW": lambda x, y: x**y,
    "CONSTPOW": lambda x, _: x**2.5,
    "FMOD": ca.fmod,
    "COPYSIGN": ca.copysign,
    "ATAN2": ca.atan2,
    "HYPOT": ca.hypot,
}


@cache
def library():
    text = resources.files("greybox.estimation").joinpath("tape.c").read_text()
    return ctypes.CDLL(str(build([("gb_tape.c", text, DRIVER_FLAGS)])))


def run(function, *arguments):
    """Results (lanes, nonzeros) of the tape for arguments (lanes, n)."""
    tape, lanes = tape_of(function), len(arguments[0])
    wide = 8 * int(library().gb_tape_width(lanes))
    rows = [np.ascontiguousarray(a[min(i, lanes - 1)]) for a in arguments for i in range(wide)]
    pointers = (ctypes.c_void_p * len(rows))(*(r.ctypes.data for r in rows))
    results = [np.full((lanes, n), np.nan) for n in tape.lengths]
    into = (ctypes.c_void_p * len(results))(*(r.ctypes.data for r in results))
    work = np.empty(tape.work)
    own = (tape.instructions, tape.constants, tape.lengths, work)
    instructions, constants, lengths, memory = (ctypes.c_void_p(v.ctypes.data) for v in own)
    library().gb_tape(instructions, constants, pointers, into, lengths, memory, lanes)
    return results


def check(function, *arguments, rtol=1e-12):
    for lane in range(len(arguments[0])):
        expected = function.call([a[lane] for a in arguments])
        for found, value in zip(run(function, *arguments), expected, strict=True):
            np.testing.assert_allclose(found[lane], value.nonzeros(), rtol=rtol, atol=1e-14)


@needs_compiler
@pytest.mark.parametrize("lanes", [1, 2, 7, 8, 9, 16, 17, 25, SAMPLES])
def test_any_number_of_samples_gives_each_its_own(lanes):
    x, u = ca.SX.sym("x", 3), ca.SX.sym("u", 2)
    sparse = ca.SX(ca.Sparsity.lower(3))
    sparse[0, 0], sparse[2, 1], sparse[2, 2] = x[0] * u[1] - x[2], 2.5, ca.exp(-(x[1] ** 2))
    rng = np.random.default_rng(lanes)
    f = ca.Function("f", [x, u], [sparse, x * u[0] + x[::-1], u[1]])
    check(f, rng.normal(size=(lanes, 3)), rng.normal(size=(lanes, 2)))


@needs_compiler
@pytest.mark.parametrize("name", [*ONE, *TWO])
def test_every_instruction_is_the_operation_of_its_name(name):
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    f = ca.Function("f", [x, y], [ONE[name](x) if name in ONE else TWO[name](x, y)])
    made = {ORDER[i] for i in tape_of(f).instructions[:, 0]}
    assert name in made
    numbers = np.array([-2.5, -1.0, -0.3, -0.0, 0.0, 0.2, 1.0, 3.7, np.inf, np.nan])
    pairs = np.array([(a, b) for a in numbers for b in numbers])
    for begin in range(0, len(pairs), SAMPLES):
        part = pairs[begin : begin + SAMPLES]
        check(f, part[:, :1], part[:, 1:])


@needs_compiler
@settings(deadline=None, max_examples=60, derandomize=True)
@given(st.data())
def test_random_expressions_are_those_of_casadi(data):
    """Products that are added, shared and kept, in any order."""
    x = ca.SX.sym("x", 4)
    known = [x[i] for i in range(4)]
    smooth = ("ADD", "SUB", "MUL", "MUL", "FMIN", "IF_ELSE_ZERO")
    for _ in range(data.draw(st.integers(1, 60))):
        pick = st.integers(max(0, len(known) - 8), len(known) - 1)
        a, b = known[data.draw(pick)], known[data.draw(pick)]
        name = data.draw(st.sampled_from([*smooth, "SIN", "NEG", "TANH"]))
        known.append(ONE[name](a) if name in ONE else TWO[name](a, b))
    kept = [known[data.draw(st.integers(0, len(known) - 1))] for _ in range(5)]
    rng = np.random.default_rng(0)
    check(
        ca.Function("f", [x], [ca.vertcat(*kept, known[-1])]),
        rng.uniform(-1, 1, size=(5, 4)),
        rtol=1e-9,
    )


@needs_compiler
def test_a_function_without_operations_has_a_tape_that_ends():
    tape = tape_of(ca.Function("f", [ca.SX.sym("x", 2)], [ca.SX(2, 0)]))
    assert tape.instructions[:, 0].tolist() == [CODE["END"]]
    assert (tape.slots, tape.lengths.tolist()) == (0, [0])


@needs_compiler
def test_a_product_that_is_used_twice_stays():
    x = ca.SX.sym("x", 3)
    product = x[0] * x[1]
    f = ca.Function("f", [x], [ca.vertcat(product + x[2], product - x[2], x[2] - product)])
    assert (tape_of(f).instructions[:, 0] == CODE["MUL"]).sum() == 1
    g = ca.Function("g", [x], [x[2] - x[0] * x[1]])
    assert (tape_of(g).instructions[:, 0] == CODE["SUB_MUL"]).sum() == 1
    rng = np.random.default_rng(0)
    for h in (f, g):
        check(h, rng.normal(size=(4, 3)))


def test_what_has_no_tape_is_said():
    x = ca.SX.sym("x")
    with pytest.raises(ModelError, match="ERFINV"):
        tape_of(ca.Function("f", [x], [ca.erfinv(x)]))
    many = ca.SX.sym("m", MOST)
    with pytest.raises(ModelError, match="too large"):
        tape_of(ca.Function("f", [many], [many[0]]))
