"""A scalar CasADi function as plain values, operation by operation, and back.

Model files hold the equations of a user's own model in this form: reading one executes nothing but
arithmetic, and the names of operations, unlike CasADi's own files, outlive its versions. (Exports
write whole families of functions, matrices included, with `mpc_export.tape`.)
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca

from greybox.errors import FileFormatError, ModelError
from greybox.files import Json, Parsed
from greybox.symbolic import Expr

LONGEST = 1_000_000
"""Operations of one function: what is longer was not written here."""


@functools.cache
def _codes() -> Mapping[str, int]:
    """Operation name -> code of this CasADi."""
    names = (n for n in dir(ca) if n.startswith("OP_"))
    return {n.removeprefix("OP_"): int(getattr(ca, n)) for n in names}


def write_function(function: ca.Function) -> dict[str, Json]:
    """Plain values of an SX function: shapes of arguments and results, and one row per operation.

    A row is [name, result slot, arguments...]: slots, or argument number and entry (INPUT), result
    number, entry and slot (OUTPUT, without a result slot), a number (CONST). Raises `ModelError`
    for a function that is not made of scalar operations.
    """
    if not function.is_a("SXFunction"):
        raise ModelError(
            f"{function.name()} is not made of scalar operations",
            expected="an SX function",
            got=function.class_name(),
        )
    names = {code: name for name, code in _codes().items()}
    rows: list[list[str | float]] = []
    for k in range(function.n_instructions()):
        name = names[function.instruction_id(k)]
        put = [int(i) for i in function.instruction_output(k)]
        taken = [int(i) for i in function.instruction_input(k)]
        if name == "CONST":
            rows.append([name, put[0], float(function.instruction_constant(k))])
        elif name == "OUTPUT":
            rows.append([name, *put, *taken])
        else:
            rows.append([name, put[0], *taken])
    return {
        "arguments": [list(function.size_in(i)) for i in range(function.n_in())],
        "results": [list(function.size_out(i)) for i in range(function.n_out())],
        "nonzeros": [
            [list(map(int, part)) for part in _triplet(function.sparsity_out(i))]
            for i in range(function.n_out())
        ],
        "operations": rows,
    }


def _triplet(sparsity: ca.Sparsity) -> tuple[list[int], list[int]]:
    rows, columns = sparsity.get_triplet()
    return rows, columns


def read_function(name: str, values: Parsed) -> ca.Function:
    """The function that `write_function` wrote. Raises `FileFormatError` for anything else."""
    try:
        if len(values["operations"]) > LONGEST:
            raise ValueError(f"{len(values['operations'])} operations")
        given = [ca.SX.sym(f"a{i}", *map(int, s)) for i, s in enumerate(values["arguments"])]
        entries = [g.nonzeros() for g in given]
        results = [[ca.SX(0)] * len(part[0]) for part in values["nonzeros"]]
        work: dict[int, Expr] = {}
        for row in values["operations"]:
            _apply(row, entries, results, work)
        outputs = []
        for size, (rows, columns), part in zip(
            values["results"], values["nonzeros"], results, strict=True
        ):
            out = ca.SX(*map(int, size))
            for i, j, v in zip(rows, columns, part, strict=True):
                out[int(i), int(j)] = v
            outputs.append(out)
        return ca.Function(name, given, outputs)
    except (KeyError, TypeError, ValueError, IndexError, RuntimeError) as error:
        raise FileFormatError(
            f"not an expression of a model ({error})", fix="write the file again"
        ) from None


def _apply(
    row: Sequence[Any], entries: Sequence[Expr], results: Sequence[Expr], work: dict[int, Expr]
) -> None:
    """One operation: slots in `work`, symbols in `entries`, what comes out in `results`."""
    name, *rest = row
    if name == "CONST":
        work[rest[0]] = ca.SX(float(rest[1]))
    elif name == "INPUT":
        work[rest[0]] = entries[rest[1]][rest[2]]
    elif name == "OUTPUT":
        results[rest[0]][rest[1]] = work[rest[2]]
    elif len(rest) == 2:
        work[rest[0]] = ca.SX.unary(_codes()[name], work[rest[1]])
    elif len(rest) == 3:
        work[rest[0]] = ca.SX.binary(_codes()[name], work[rest[1]], work[rest[2]])
    else:
        raise ValueError(f"operation {name}")
