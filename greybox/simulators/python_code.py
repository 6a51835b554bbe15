"""A CasADi function as Python source: one assignment per operation, on numbers or whole batches.

The model stays written once: what NumPy and JAX run is generated from the same expressions that the
fit used, so that the three cannot differ.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping

import casadi as ca

from greybox.errors import ModelError

NUMBERS = '''class _Numbers:
    """Mathematics of single numbers: faster than NumPy's for one craft."""

    abs, minimum, maximum = abs, staticmethod(min), staticmethod(max)
    exp, log, sqrt, sin, cos, tan = math.exp, math.log, math.sqrt, math.sin, math.cos, math.tan
    arcsin, arccos, arctan, arctan2 = math.asin, math.acos, math.atan, math.atan2
    tanh, floor, ceil, copysign = math.tanh, math.floor, math.ceil, math.copysign
    log1p = math.log1p

    @staticmethod
    def true(a):
        return 1.0 if a != 0 else 0.0

    @staticmethod
    def sign(a):
        return (a > 0) - (a < 0)

    @staticmethod
    def where(condition, a, b):
        return a if condition else b
'''
"""What generated source takes its mathematics of single numbers from."""
INFIX = {"ADD": "+", "SUB": "-", "MUL": "*", "DIV": "/", "POW": "**", "CONSTPOW": "**"}
COMPARED = {"LT": "<", "LE": "<=", "EQ": "==", "NE": "!="}
PLAIN = {
    "ASSIGN": "{0}",
    "NEG": "-{0}",
    "SQ": "{0} * {0}",
    "TWICE": "2.0 * {0}",
    "INV": "1.0 / {0}",
    "FABS": "m.abs({0})",
    "NOT": "1.0 - m.true({0})",
    "AND": "m.true({0}) * m.true({1})",
    "OR": "m.maximum(m.true({0}), m.true({1}))",
    "IF_ELSE_ZERO": "m.where({0} != 0, {1}, 0.0)",
    "FMIN": "m.minimum({0}, {1})",
    "FMAX": "m.maximum({0}, {1})",
    "ATAN2": "m.arctan2({0}, {1})",
    "COPYSIGN": "m.copysign({0}, {1})",
    "SIGN": "m.sign({0})",
    "EXP": "m.exp({0})",
    "LOG": "m.log({0})",
    "LOG1P": "m.log1p({0})",
    "SQRT": "m.sqrt({0})",
    "SIN": "m.sin({0})",
    "COS": "m.cos({0})",
    "TAN": "m.tan({0})",
    "ASIN": "m.arcsin({0})",
    "ACOS": "m.arccos({0})",
    "ATAN": "m.arctan({0})",
    "TANH": "m.tanh({0})",
    "FLOOR": "m.floor({0})",
    "CEIL": "m.ceil({0})",
}
"""Operation by its CasADi name -> Python; `m` is a module of mathematics."""


@functools.cache
def _operations() -> Mapping[int, str]:
    found = {}
    for n in sorted(dir(ca), reverse=True):
        if n.startswith("OP_"):
            found[getattr(ca, n)] = n.removeprefix("OP_")
    return found


def python_source(function: ca.Function, name: str, arguments: tuple[str, ...]) -> str:
    """`def name(arguments..., m)` that returns a list with the entries of the first output.

    Arguments are indexed by entry, column by column; `function` is one of scalars (SX) with a dense
    output. Raises `ModelError` for an operation without a counterpart.
    """
    operations = _operations()
    lines = [f"def {name}({', '.join(arguments)}, m):"]
    results: list[str] = ["0.0"] * function.nnz_out(0)
    for k in range(function.n_instructions()):
        kind = operations[function.instruction_id(k)]
        to, given = function.instruction_output(k), function.instruction_input(k)
        if kind == "OUTPUT":
            lines.append(f"    r{to[1]} = w{given[0]}")
            results[to[1]] = f"r{to[1]}"
            continue
        if kind == "CONST":
            value = repr(float(function.instruction_constant(k)))
        elif kind == "INPUT":
            value = f"{arguments[given[0]]}[{given[1]}]"
        else:
            value = _operation(kind, [f"w{i}" for i in given])
        lines.append(f"    w{to[0]} = {value}")
    lines.append(f"    return [{', '.join(results)}]")
    return "\n".join(lines) + "\n"


def _operation(kind: str, given: list[str]) -> str:
    if kind in INFIX:
        return f"{given[0]} {INFIX[kind]} {given[1]}"
    if kind in COMPARED:
        return f"1.0 * ({given[0]} {COMPARED[kind]} {given[1]})"
    if kind not in PLAIN:
        raise ModelError(
            f"the operation {kind.lower()} of this model has no counterpart in NumPy",
            fix="write your effect with the operations of greybox/simulators/python_code.py",
        )
    return PLAIN[kind].format(*given)
