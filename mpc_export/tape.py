"""Tapes: CasADi functions as plain numbers, instruction by instruction, by operation name.

The files that a bundle carries (`functions.json`, `functions.npz`) and the interpreter that reads
them (mpc_export/rebuild/rebuild.py). CasADi's own files are bound to its version and its operation
codes change between versions; the names of the operations do not.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable

import casadi as ca
import numpy as np
import numpy.typing as npt

from greybox.errors import ModelError
from greybox.files import Json
from greybox.symbolic import Expr, FloatArray, operation_names
from mpc_export.rebuild.rebuild import BINARY, SCHEMA, SHAPED, UNARY, WHOLE

_SCALAR = {"INPUT", "OUTPUT", "CONST", *UNARY, *BINARY}
_MATRIX = {*_SCALAR, "CALL", *WHOLE, *SHAPED}


def write_tape(functions: Iterable[ca.Function]) -> tuple[TapeDocument, dict[str, TapeArray]]:
    """(JSON value, arrays) of the functions and everything that they call. Raises `ModelError` for
    what has no tape."""
    return _Writer().write(list(functions))


TapeArray = FloatArray | npt.NDArray[np.int32]
"""An array of functions.npz."""
Tape = dict[str, Json]
"""One function: name, kind ("scalar" or "matrix"), whether it is public, its ports, and its
instructions or the names of their arrays, as mpc_export/rebuild/rebuild.py reads them."""
TapeDocument = dict[str, Json]
"""functions.json: schema, names of operations, tapes."""


class _Writer:
    """Collects tapes; functions and constants that occur twice are written once."""

    def __init__(self) -> None:
        self.tapes: list[Tape] = []
        self.arrays: dict[str, TapeArray] = {}
        self.operations: list[str] = []
        self.codes: dict[str, int] = {}
        self.places: dict[int, tuple[ca.Function, int]] = {}
        self.constants: dict[str, str] = {}

    def write(self, functions: list[ca.Function]) -> tuple[TapeDocument, dict[str, TapeArray]]:
        for f in functions:
            self.tapes[self.place(f)]["public"] = True
        return {
            "schema": SCHEMA,
            "operations": self.operations,
            "functions": self.tapes,
        }, self.arrays

    def place(self, function: ca.Function) -> int:
        """Index of a function's tape, written where it is not there yet."""
        key = function.__hash__()
        if key not in self.places:
            if function.is_a("SXFunction"):
                tape = self.scalar(function)
            elif function.is_a("MXFunction"):
                tape = self.matrix(function)
            else:
                raise ModelError(
                    f"no tape of {function.name()}",
                    expected="a function of expressions",
                    got=function.class_name(),
                )
            self.tapes.append(tape)
            self.places[key] = (function, len(self.tapes) - 1)
        return self.places[key][1]

    def code(self, name: str, known: set[str], function: ca.Function) -> int:
        if name not in known:
            raise ModelError(f"{function.name()} uses the operation {name}, which has no tape")
        if name not in self.codes:
            self.codes[name] = len(self.operations)
            self.operations.append(name)
        return self.codes[name]

    def head(self, function: ca.Function, kind: str, rest: Tape) -> Tape:
        return {
            "name": function.name(),
            "kind": kind,
            "public": False,
            "in": [
                _port(function.sparsity_in(i), function.name_in(i)) for i in range(function.n_in())
            ],
            "out": [
                _port(function.sparsity_out(i), function.name_out(i))
                for i in range(function.n_out())
            ],
            **rest,
        }

    def scalar(self, function: ca.Function) -> Tape:
        names = operation_names()
        n = function.n_instructions()
        op, to, a, b = (np.zeros(n, dtype=np.int32) for _ in range(4))
        value = np.zeros(n)
        for k in range(n):
            name = names[function.instruction_id(k)]
            op[k] = self.code(name, _SCALAR, function)
            into, out = function.instruction_output(k), function.instruction_input(k)
            if name == "CONST":
                to[k], value[k] = into[0], function.instruction_constant(k)
            elif name == "INPUT":
                to[k], a[k], b[k] = into[0], out[0], out[1]
            elif name == "OUTPUT":
                to[k], a[k], b[k] = into[0], out[0], into[1]
            else:
                to[k], a[k] = into[0], out[0]
                b[k] = out[1] if len(out) > 1 else 0
        key = f"t{len(self.tapes)}_{function.name()}"
        for part, array in (("op", op), ("to", to), ("a", a), ("b", b), ("value", value)):
            self.arrays[f"{key}_{part}"] = array
        return self.head(function, "scalar", {"work": int(function.sz_w()) + 1, "arrays": key})

    def matrix(self, function: ca.Function) -> Tape:
        names = operation_names()
        instructions: list[list[Json]] = []
        for k in range(function.n_instructions()):
            name = names[function.instruction_id(k)]
            code = self.code(name, _MATRIX, function)
            node = function.instruction_MX(k)
            arguments, results = (
                list(function.instruction_input(k)),
                list(function.instruction_output(k)),
            )
            extra: dict[str, Json] = {}
            if name == "INPUT":
                info = node.info()
                arguments, extra = [], {"argument": int(info["ind"])}
                if node.sparsity() != function.sparsity_in(info["ind"]):  # a part of it
                    extra |= {"first": int(info["offset"]), **_port(node.sparsity())}
            elif name == "OUTPUT":
                info = node.info()
                results, extra = [], {"result": int(info["ind"]), "segment": int(info["segment"])}
            elif name == "CONST":
                extra = {**_port(node.sparsity()), "array": self.constant(node.to_DM())}
            elif name == "CALL":
                extra = {"function": self.place(node.which_function())}
            elif name in ("HORZSPLIT", "VERTSPLIT"):
                extra = {"offset": _offsets(node, name)}
            elif name in ("HORZREPMAT", "HORZREPSUM"):
                wide, narrow = sorted((node.shape[1], node.dep(0).shape[1]), reverse=True)
                extra = {"n": wide // narrow}
            elif name in ("GETNONZEROS", "SETNONZEROS", "ADDNONZEROS"):
                extra = {
                    **_port(node.sparsity()),
                    "entries": [int(v) for v in node.mapping().nonzeros()],
                }
            elif name in SHAPED:
                extra = _port(node.sparsity())
            instructions.append(
                [code, [int(v) for v in arguments], [int(v) for v in results], extra]
            )
        return self.head(function, "matrix", {"instructions": instructions})

    def constant(self, value: ca.DM) -> str:
        numbers = np.array(value.nonzeros(), dtype=np.float64)
        key = hashlib.sha256(numbers.tobytes()).hexdigest()
        if key not in self.constants:
            self.constants[key] = f"c{len(self.constants)}"
            self.arrays[self.constants[key]] = numbers
        return self.constants[key]


def _offsets(node: Expr, name: str) -> list[int]:
    """Where the parts of a split begin, in rows or columns, with the end at last."""
    pieces = node.info()["output"]
    sizes = [
        pieces.size1_out(i) if name == "VERTSPLIT" else pieces.size2_out(i)
        for i in range(pieces.n_out())
    ]
    return [0, *np.cumsum(sizes).tolist()]


def _port(sparsity: ca.Sparsity, name: str | None = None) -> dict[str, Json]:
    out: dict[str, Json] = {} if name is None else {"name": name}
    out |= {"rows": int(sparsity.size1()), "columns": int(sparsity.size2())}
    if not sparsity.is_dense():
        out |= {
            "colind": [int(v) for v in sparsity.colind()],
            "row": [int(v) for v in sparsity.row()],
        }
    return out
