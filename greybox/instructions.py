"""A small CasADi function over many samples: each of its instructions for all of them at once.

CasADi's virtual machine takes some 10 ns for an instruction of one sample, also for a product. NumPy
takes 1 ns where it has a thousand samples. The formula stays where it is written.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence

import casadi as ca
import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
Number = FloatArray | float
Call = Callable[..., Number]
FEWEST = 500
"""Samples from which on this is the faster way."""
PIECE = 2048
"""Samples at a time: all numbers of a small function stay in the cache of a core."""


def _of_truth(call: Call) -> Call:
    """One and zero for true and false, as CasADi has them."""
    return lambda *numbers: np.where(call(*numbers), 1.0, 0.0)


CALLS: dict[int, Call] = {
    ca.OP_ADD: np.add,
    ca.OP_SUB: np.subtract,
    ca.OP_MUL: np.multiply,
    ca.OP_DIV: np.divide,
    ca.OP_NEG: np.negative,
    ca.OP_TWICE: lambda x: 2.0 * x,
    ca.OP_SQ: np.square,
    ca.OP_SQRT: np.sqrt,
    ca.OP_FABS: np.abs,
    ca.OP_SIN: np.sin,
    ca.OP_COS: np.cos,
    ca.OP_ASIN: np.arcsin,
    ca.OP_ACOS: np.arccos,
    ca.OP_ATAN2: np.arctan2,
    ca.OP_FMIN: np.fmin,
    ca.OP_FMAX: np.fmax,
    ca.OP_LT: _of_truth(np.less),
    ca.OP_LE: _of_truth(np.less_equal),
    ca.OP_NOT: _of_truth(np.logical_not),
    ca.OP_IF_ELSE_ZERO: lambda condition, x: np.where(condition, x, 0.0),
}
"""What instructions do, by their CasADi number."""
MOVES = (ca.OP_CONST, ca.OP_INPUT, ca.OP_OUTPUT)


@functools.lru_cache(maxsize=64)
def instructions(function: ca.Function) -> list[tuple[int, list[int], list[int], float]] | None:
    """(what it does, where to, where from, the constant) of each instruction; None for a function
    with one that is not known here."""
    if not function.is_a("SXFunction"):
        return None
    kinds = [function.instruction_id(k) for k in range(function.n_instructions())]
    if any(kind not in CALLS and kind not in MOVES for kind in kinds):
        return None
    return [
        (
            kind,
            function.instruction_output(k),
            function.instruction_input(k),
            function.instruction_constant(k) if kind == ca.OP_CONST else 0.0,
        )
        for k, kind in enumerate(kinds)
    ]


def carried_out(function: ca.Function, columns: Sequence[FloatArray], out: FloatArray) -> bool:
    """Whether all instructions are known here: then the single dense output of the function of dense
    columns (n, n_i) is written to `out` (n, n_o)."""
    steps = instructions(function)
    if steps is None:
        return False
    with np.errstate(all="ignore"):
        for at in range(0, len(out), PIECE):
            _carry_out(steps, [c[at : at + PIECE] for c in columns], out[at : at + PIECE])
    return True


def _carry_out(
    steps: Sequence[tuple[int, list[int], list[int], float]],
    columns: Sequence[FloatArray],
    out: FloatArray,
) -> None:
    numbers: dict[int, Number] = {}
    for kind, to, of, constant in steps:
        if kind == ca.OP_INPUT:
            numbers[to[0]] = np.ascontiguousarray(columns[of[0]][:, of[1]])
        elif kind == ca.OP_OUTPUT:
            out[:, to[1]] = numbers[of[0]]
        elif kind == ca.OP_CONST:
            numbers[to[0]] = constant
        else:
            numbers[to[0]] = CALLS[kind](*(numbers[i] for i in of))
