"""Rebuild the CasADi functions of this bundle from plain numbers. Needs casadi (3.6.7 or later) and
numpy, nothing else.

    import rebuild
    functions = rebuild.load()          # name -> casadi.Function
    x_next = functions["f_d"](x, u, p)

`functions.json` holds one tape per function: instructions by operation name (codes differ between
CasADi versions, names do not), work slots, and for every argument and result its shape.
`functions.npz` holds the long arrays: scalar tapes (physics) and dense constants (the Gaussian
process). Nothing is executed but the operations listed here.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

Expr = Any
"""A CasADi expression, SX or MX."""
Tape = Mapping[str, Any]
"""One function of functions.json, or a port or the settings of an instruction in it."""
Arrays = Mapping[str, np.ndarray]
"""What functions.npz holds."""
SCHEMA = "greybox.tape/1"
LARGEST, LARGEST_ARCHIVE = 4_000_000, 500_000_000
"""Entries of one matrix or slots of one tape, and bytes of functions.npz unpacked: what is larger
was not exported."""


def _if_else_zero(c: Expr, x: Expr) -> Expr:
    return ca.if_else(c, x, 0)


UNARY: Mapping[str, Callable[[Expr], Expr]] = {
    "ASSIGN": lambda x: x,
    "NEG": lambda x: -x,
    "EXP": ca.exp,
    "LOG": ca.log,
    "SQRT": ca.sqrt,
    "SQ": lambda x: x * x,
    "TWICE": lambda x: x + x,
    "SIN": ca.sin,
    "COS": ca.cos,
    "TAN": ca.tan,
    "ASIN": ca.asin,
    "ACOS": ca.acos,
    "ATAN": ca.atan,
    "FLOOR": ca.floor,
    "CEIL": ca.ceil,
    "NOT": ca.logic_not,
    "FABS": ca.fabs,
    "SIGN": ca.sign,
    "ERF": ca.erf,
    "INV": lambda x: 1 / x,
    "SINH": ca.sinh,
    "COSH": ca.cosh,
    "TANH": ca.tanh,
    "ASINH": ca.asinh,
    "ACOSH": ca.acosh,
    "ATANH": ca.atanh,
    "LOG1P": ca.log1p,
    "EXPM1": ca.expm1,
}
BINARY: Mapping[str, Callable[[Expr, Expr], Expr]] = {
    "ADD": lambda x, y: x + y,
    "SUB": lambda x, y: x - y,
    "MUL": lambda x, y: x * y,
    "DIV": lambda x, y: x / y,
    "POW": lambda x, y: x**y,
    "CONSTPOW": lambda x, y: x**y,
    "LT": lambda x, y: x < y,
    "LE": lambda x, y: x <= y,
    "EQ": lambda x, y: x == y,
    "NE": lambda x, y: x != y,
    "AND": ca.logic_and,
    "OR": ca.logic_or,
    "FMOD": ca.fmod,
    "COPYSIGN": ca.copysign,
    "IF_ELSE_ZERO": _if_else_zero,
    "FMIN": ca.fmin,
    "FMAX": ca.fmax,
    "ATAN2": ca.atan2,
    "HYPOT": ca.hypot,
}
WHOLE: Mapping[str, Callable[..., Expr]] = {
    "TRANSPOSE": lambda x: x.T,
    "DOT": ca.dot,
    "MTIMES": lambda z, x, y: ca.mac(x, y, z),
    "HORZCAT": ca.horzcat,
    "VERTCAT": ca.vertcat,
    "DIAGCAT": ca.diagcat,
    "MMIN": ca.mmin,
    "MMAX": ca.mmax,
    "NORM1": ca.norm_1,
    "NORM2": ca.norm_2,
    "NORMF": ca.norm_fro,
    "NORMINF": ca.norm_inf,
}
"""Operations of matrices without settings. SHAPED ones take the result's sparsity or a list of
numbers too (`_matrix`)."""
SHAPED = (
    "RESHAPE",
    "PROJECT",
    "SPARSITY_CAST",
    "HORZREPMAT",
    "HORZREPSUM",
    "HORZSPLIT",
    "VERTSPLIT",
    "GETNONZEROS",
    "SETNONZEROS",
    "ADDNONZEROS",
)


def load(
    folder: str | Path | None = None, names: Iterable[str] | None = None
) -> dict[str, ca.Function]:
    """Functions by name from `functions.json` and `functions.npz` in `folder` (default: where this
    file is).

    `names` are the ones to build (default: all). Raises `ValueError` for another schema or an
    operation that this file does not know, `KeyError` for a name that is not there.
    """
    where = Path(__file__).resolve().parent if folder is None else Path(folder)
    text = json.loads((where / "functions.json").read_text(encoding="utf-8"))
    if text.get("schema") != SCHEMA:
        raise ValueError(f"{where}: schema {text.get('schema')!r}, expected {SCHEMA!r}")
    with np.load(where / "functions.npz", allow_pickle=False) as stored:
        if sum(entry.file_size for entry in stored.zip.infolist()) > LARGEST_ARCHIVE:
            raise ValueError(f"{where}: functions.npz unpacks to more than {LARGEST_ARCHIVE} bytes")
        arrays = {name: stored[name] for name in stored.files}
    tapes, operations = text["functions"], text["operations"]
    places = {tape["name"]: k for k, tape in enumerate(tapes) if tape["public"]}
    built: dict[int, ca.Function] = {}

    def build(place: int) -> ca.Function:
        if place not in built:
            tape = tapes[place]
            if tape["kind"] == "scalar":
                built[place] = _scalar(tape, operations, arrays)
            else:
                built[place] = _matrix(tape, operations, arrays, build)
        return built[place]

    return {name: build(places[name]) for name in (places if names is None else names)}


def sparsity(port: Tape) -> ca.Sparsity:
    """casadi.Sparsity of {rows, columns} (dense) or {rows, columns, colind, row}. Raises `ValueError`
    for more than LARGEST entries."""
    if not (0 <= port["rows"] <= LARGEST and 0 <= port["columns"] <= LARGEST):
        raise ValueError(f"a matrix of {port['rows']} x {port['columns']}")
    if "colind" not in port:
        if port["rows"] * port["columns"] > LARGEST:
            raise ValueError(f"a matrix of {port['rows']} x {port['columns']}")
        return ca.Sparsity.dense(port["rows"], port["columns"])
    return ca.Sparsity(port["rows"], port["columns"], port["colind"], port["row"])


def _scalar(tape: Tape, names: list[str], arrays: Arrays) -> ca.Function:
    """A function of scalars (SX): arrays of operation, result slot, two argument slots, and a
    constant."""
    inputs = [ca.SX.sym(port["name"], sparsity(port)) for port in tape["in"]]
    given = [x.nonzeros() for x in inputs]
    results: list[list[Expr]] = [[0.0] * sparsity(port).nnz() for port in tape["out"]]
    if not 0 <= tape["work"] <= LARGEST:
        raise ValueError(f"{tape['name']}: {tape['work']} slots")
    work: list[Expr] = [None] * tape["work"]
    unary, binary = [UNARY.get(n) for n in names], [BINARY.get(n) for n in names]
    kinds = {n: i for i, n in enumerate(names)}
    constant, taken, put = (kinds.get(n, -1) for n in ("CONST", "INPUT", "OUTPUT"))
    key = tape["arrays"]
    rows = zip(
        *(arrays[f"{key}_{part}"].tolist() for part in ("op", "to", "a", "b", "value")), strict=True
    )
    for op, to, a, b, value in rows:
        if op == constant:
            work[to] = ca.SX(value)
        elif op == taken:
            work[to] = given[a][b]
        elif op == put:
            results[to][b] = work[a]
        elif unary[op] is not None:
            work[to] = unary[op](work[a])
        elif binary[op] is not None:
            work[to] = binary[op](work[a], work[b])
        else:
            raise ValueError(f"{tape['name']}: unknown operation {names[op]}")
    outputs = []
    for port, values in zip(tape["out"], results, strict=True):
        column = ca.vertcat(*values) if values else ca.SX(0, 1)
        outputs.append(ca.SX(sparsity(port), ca.SX(column)))
    return ca.Function(
        tape["name"],
        inputs,
        outputs,
        [q["name"] for q in tape["in"]],
        [q["name"] for q in tape["out"]],
    )


def _matrix(
    tape: Tape,
    names: list[str],
    arrays: Arrays,
    build: Callable[[int], ca.Function],
) -> ca.Function:
    """A function of matrices (MX): a list of [operation, argument slots, result slots,
    settings]."""
    inputs = [ca.MX.sym(port["name"], sparsity(port)) for port in tape["in"]]
    segments: list[dict[int, Expr]] = [{} for _ in tape["out"]]
    work: dict[int, Expr] = {}
    for op, arguments, results, extra in tape["instructions"]:
        name = names[op]
        given = [work[i] for i in arguments if i >= 0]
        if name == "INPUT":
            work[results[0]] = _argument(inputs[extra["argument"]], extra)
        elif name == "OUTPUT":
            segments[extra["result"]][extra["segment"]] = given[0]
        elif name == "CONST":
            work[results[0]] = ca.MX(ca.DM(sparsity(extra), arrays[extra["array"]]))
        elif name == "CALL":
            function = build(extra["function"])
            empty = [
                ca.MX(function.size1_in(i), function.size2_in(i)) for i in range(function.n_in())
            ]
            values = function.call(
                [work[i] if i >= 0 else empty[k] for k, i in enumerate(arguments)]
            )
            work.update((slot, v) for slot, v in zip(results, values, strict=True) if slot >= 0)
        elif name in ("HORZSPLIT", "VERTSPLIT"):
            split = ca.horzsplit if name == "HORZSPLIT" else ca.vertsplit
            pieces = split(given[0], extra["offset"])
            work.update((slot, v) for slot, v in zip(results, pieces, strict=True) if slot >= 0)
        elif name in SHAPED:
            work[results[0]] = _shaped(name, given, extra)
        elif name in WHOLE:
            work[results[0]] = WHOLE[name](*given)
        elif name in UNARY:
            work[results[0]] = UNARY[name](given[0])
        elif name in BINARY:
            work[results[0]] = BINARY[name](given[0], given[1])
        else:
            raise ValueError(f"{tape['name']}: unknown operation {name}")
        if any(work[slot].nnz() > LARGEST for slot in results if slot in work):
            raise ValueError(
                f"{tape['name']}: {name} makes a matrix of more than {LARGEST} entries"
            )
    outputs = [_joined(*pair) for pair in zip(tape["out"], segments, strict=True)]
    return ca.Function(
        tape["name"],
        inputs,
        outputs,
        [q["name"] for q in tape["in"]],
        [q["name"] for q in tape["out"]],
    )


def _joined(port: Tape, parts: Mapping[int, Expr]) -> Expr:
    """A result from its segments."""
    shape = sparsity(port)
    if not parts:
        return ca.MX(port["rows"], port["columns"])
    if len(parts) == 1 and parts[0].sparsity() == shape:
        return parts[0]
    return ca.MX(shape, ca.vertcat(*(_column(parts[k]) for k in sorted(parts))))


def _argument(x: Expr, extra: Tape) -> Expr:
    if "first" not in extra:
        return x
    shape = sparsity(extra)
    return ca.MX(shape, x.nz[extra["first"] : extra["first"] + shape.nnz()])


def _column(x: Expr) -> Expr:
    """The stored entries of a matrix as one dense column."""
    return (
        x if x.is_column() and x.is_dense() else ca.reshape(x.nz[:], x.nnz(), 1)
    )  # of a row the entries are a row


def _shaped(name: str, given: list[Expr], extra: Tape) -> Expr:
    if name == "RESHAPE":
        return ca.reshape(given[0], sparsity(extra))
    if name == "PROJECT":
        return ca.project(given[0], sparsity(extra))
    if name == "SPARSITY_CAST":
        return ca.MX(sparsity(extra), _column(given[0]))
    if name == "HORZREPMAT" and given[0].size2() * extra["n"] > LARGEST:
        raise ValueError(f"a matrix of {extra['n']} copies")
    if name == "HORZREPMAT":
        return ca.repmat(given[0], 1, extra["n"])
    if name == "HORZREPSUM":
        return ca.repsum(given[0], 1, extra["n"])
    entries = extra["entries"]
    if name == "GETNONZEROS":
        source = _column(given[0])
        if min(entries, default=0) < 0:  # an entry that the source does not store
            source = ca.vertcat(source, 0)
            entries = [e if e >= 0 else source.numel() - 1 for e in entries]
        return ca.MX(sparsity(extra), source.nz[entries])
    # Written into or added to the stored entries of the first argument; -1 is nowhere.
    kept, source = [(e, k) for k, e in enumerate(entries) if e >= 0], _column(given[1])
    n = given[0].nnz()
    if name == "ADDNONZEROS":
        into = ca.DM.triplet(
            [e for e, _ in kept], [k for _, k in kept], [1.0] * len(kept), n, len(entries)
        )
        return ca.MX(given[0].sparsity(), _column(given[0]) + ca.mtimes(into, source))
    order = dict(kept)  # the last one counts
    whole: Expr = ca.vertcat(_column(given[0]), source)
    return ca.MX(
        given[0].sparsity(), whole.nz[[n + order[i] if i in order else i for i in range(n)]]
    )
