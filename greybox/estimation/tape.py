"""Tapes: straight-line expressions as numbers, which `tape.c` runs for many samples at once.

Once the states of a record are known, the linearisations of its steps do not depend on each other.
An interpreter that takes one instruction for 32 samples spends little on reading it, and the
numbers stay in the processor's vectors. It is quicker than compiled code of the same expression
without optimisation, and nothing has to be compiled: expressions of tens of thousands of operations
take the compiler seconds.

A product that is added once, and used nowhere else, is one instruction with its sum.
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from greybox.errors import ModelError
from greybox.symbolic import FloatArray, operation_names

ORDER = (
    "END",
    "INPUT",
    "OUTPUT",
    "CONST",
    "ASSIGN",
    "ADD",
    "SUB",
    "MUL",
    "DIV",
    "MUL_ADD",
    "MUL_SUB",
    "SUB_MUL",
    "NEG",
    "SQ",
    "TWICE",
    "INV",
    "LT",
    "LE",
    "EQ",
    "NE",
    "NOT",
    "AND",
    "OR",
    "IF_ELSE_ZERO",
    "SQRT",
    "FABS",
    "FMIN",
    "FMAX",
    "EXP",
    "LOG",
    "SIN",
    "COS",
    "TAN",
    "ASIN",
    "ACOS",
    "ATAN",
    "FLOOR",
    "CEIL",
    "ERF",
    "SINH",
    "COSH",
    "TANH",
    "ASINH",
    "ACOSH",
    "ATANH",
    "LOG1P",
    "EXPM1",
    "POW",
    "CONSTPOW",
    "FMOD",
    "COPYSIGN",
    "ATAN2",
    "HYPOT",
    "SIGN",
)
"""Names of the instructions, in the order of tape.c; but for the first and those with two parts
CasADi's own."""
CODE = {name: i for i, name in enumerate(ORDER)}
FUSED = {("ADD", 0): "MUL_ADD", ("ADD", 1): "MUL_ADD", ("SUB", 0): "MUL_SUB", ("SUB", 1): "SUB_MUL"}
"""A sum of a product that is its operand 0 or 1, as one instruction."""
MOST = 1 << 16
"""Slots, and numbers of an argument or result, that an instruction can tell apart."""
CHUNK = 8192
"""Neighbours that may change places."""
SAMPLES = 32
"""Samples that one pass over a tape takes at most."""
WIDTHS = (8, 16, SAMPLES)
"""Samples that a pass can take, see `gb_tape_width`."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Tape:
    """`instructions` (n, 6) and `constants` as tape.c takes them, number of work `slots`, `lengths`
    of the results (their structural nonzeros, column by column)."""

    instructions: npt.NDArray[np.uint16]
    constants: FloatArray
    slots: int
    lengths: npt.NDArray[np.int64]

    @property
    def work(self) -> int:
        """Numbers of work memory."""
        return SAMPLES * self.slots + 8


class _Carrier(ctypes.Structure):
    """`gb_linear` of driver.c."""

    _fields_ = (
        ("instructions", ctypes.c_void_p),
        ("constants", ctypes.c_void_p),
        ("lengths", ctypes.c_void_p),
        ("slots", ctypes.c_longlong),
        ("sparsity", ctypes.c_void_p * 4),
    )


class Linear:
    """The `tape` of a function with the `sparsities` of its results (CasADi's compressed form), as
    driver.c takes it: `carrier` points into what this object keeps."""

    def __init__(self, tape: Tape, sparsities: Sequence[npt.NDArray[np.int64]]) -> None:
        self._tape, self._sparsities = tape, tuple(sparsities)
        places = [v.ctypes.data for v in self._sparsities]
        self.carrier = _Carrier(
            tape.instructions.ctypes.data,
            tape.constants.ctypes.data,
            tape.lengths.ctypes.data,
            tape.work,
            (ctypes.c_void_p * 4)(*places),
        )

    @classmethod
    def of(cls, function: ca.Function) -> Linear:
        """Of a CasADi function of SX expressions. Raises `ModelError` like `tape_of`."""
        sparsities = [
            np.array(function.sparsity_out(i).compress(), dtype=np.int64)
            for i in range(function.n_out())
        ]
        return cls(tape_of(function), sparsities)

    def sparsity(self, i: int) -> npt.NDArray[np.int64]:
        """Of result i, in CasADi's compressed form."""
        return self._sparsities[i]

    def at_points(self, library: Any, *arguments: npt.ArrayLike) -> list[FloatArray]:
        """The structural nonzeros of every result, (points, numbers) each. The last argument has a
        row for every point, the others are the same for all. `library` holds `gb_tape`."""
        *common, own = (np.asarray(a, dtype=np.float64) for a in arguments)
        same = [np.ravel(a, order="F") for a in common]
        own = np.ascontiguousarray(own)
        out = [np.empty((len(own), n)) for n in self._tape.lengths]
        work = np.empty(self._tape.work)
        for begin in range(0, len(own), SAMPLES):
            rows = own[begin : begin + SAMPLES]
            wide = next(w for w in WIDTHS if w >= len(rows))
            last = [*rows, *[rows[-1]] * (wide - len(rows))]
            given = [v.ctypes.data for v in [*(a for a in same for _ in range(wide)), *last]]
            library.gb_tape(
                ctypes.c_void_p(self.carrier.instructions),
                ctypes.c_void_p(self.carrier.constants),
                (ctypes.c_void_p * len(given))(*given),
                (ctypes.c_void_p * len(out))(*(v[begin:].ctypes.data for v in out)),
                ctypes.c_void_p(self.carrier.lengths),
                ctypes.c_void_p(work.ctypes.data),
                len(rows),
            )
        return out

    def arrays(self) -> dict[str, npt.NDArray[np.generic]]:
        """All that it is made of, by name."""
        tape = self._tape
        sparsities = {f"sparsity{i}": v for i, v in enumerate(self._sparsities)}
        return {
            "instructions": tape.instructions,
            "constants": tape.constants,
            "slots": np.array(tape.slots),
            "lengths": tape.lengths,
            **sparsities,
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, npt.NDArray[Any]]) -> Linear:
        """Inverse of `arrays`."""
        tape = Tape(
            instructions=arrays["instructions"],
            constants=arrays["constants"],
            slots=int(arrays["slots"]),
            lengths=arrays["lengths"],
        )
        many = sum(name.startswith("sparsity") for name in arrays)
        return cls(tape, [arrays[f"sparsity{i}"] for i in range(many)])


def tape_of(function: ca.Function) -> Tape:
    """The tape of a CasADi function of SX expressions. Raises `ModelError` for an operation that
    has none, and for a function that is too large."""
    return _Writer(function).tape()


class _Writer:
    """Value k is what instruction k of the function makes. `operands` of every value are values."""

    def __init__(self, function: ca.Function) -> None:
        self.function = function
        n = function.n_instructions()
        names, place = operation_names(), dict[int, int]()  # which value a slot of CasADi holds
        self.names = [""] * n
        self.operands: list[tuple[int, ...]] = [()] * n
        self.where: list[tuple[int, int]] = [
            (0, 0)
        ] * n  # of inputs and outputs: which, and which number of it
        self.constants: list[float] = []
        self.uses = [0] * n
        for k in range(n):
            name = names[function.instruction_id(k)]
            if name not in CODE:
                raise ModelError(f"the expression uses the operation {name}, which has no tape")
            to, given = function.instruction_output(k), function.instruction_input(k)
            self.names[k] = name
            if name == "OUTPUT":
                self.where[k] = to[0], to[1]
                self.operands[k] = (place[given[0]],)
            elif name == "INPUT":
                self.where[k] = given[0], given[1]
            elif name == "CONST":
                self.where[k] = len(self.constants), 0
                self.constants.append(function.instruction_constant(k))
            else:
                self.operands[k] = tuple(place[g] for g in given)
            for v in self.operands[k]:
                self.uses[v] += 1
            if name != "OUTPUT":
                place[to[0]] = k

    def fuse(self) -> None:
        """Take products into the sums that alone use them."""
        names, operands, uses = self.names, self.operands, self.uses
        for k, name in enumerate(names):
            if name not in ("ADD", "SUB"):
                continue
            for i, v in enumerate(operands[k]):
                if names[v] == "MUL" and uses[v] == 1:
                    names[k] = FUSED[name, i]
                    operands[k] = (*operands[v], operands[k][1 - i])
                    names[v] = ""
                    break

    def order(self) -> list[int]:
        """Values in an order in which many neighbours are made alike, so that the processor guesses
        right which instruction comes next."""
        level = [0] * len(self.names)
        keys: list[tuple[int, int, int, int]] = []
        for k, name in enumerate(self.names):
            if name:
                part = k // CHUNK
                level[k] = max(
                    (level[v] + 1 for v in self.operands[k] if v // CHUNK == part), default=0
                )
                keys.append((part, level[k], CODE[name], k))
        return [k for *_, k in sorted(keys)]

    def tape(self) -> Tape:
        self.fuse()
        last = [-1] * len(self.names)
        kept = self.order()
        for k in kept:
            for v in self.operands[k]:
                last[v] = k
        rows: list[tuple[int, ...]] = []
        slot, free, slots = [0] * len(self.names), list[int](), 0
        for k in kept:
            name, own = self.names[k], self.operands[k]
            at = [slot[v] for v in own] + [0] * (3 - len(own))
            for v in set(own):
                if last[v] == k:
                    free.append(slot[v])
            if name == "OUTPUT":
                which, number = self.where[k]
                rows.append((CODE[name], which, at[0], number, 0, 0))
                continue
            if free:
                slot[k] = free.pop()
            else:
                slot[k], slots = slots, slots + 1
            if last[k] < 0:  # nobody asks for it
                free.append(slot[k])
            if not own:
                at = [*self.where[k], 0]
            rows.append((CODE[name], slot[k], *at, 0))
        rows.append((CODE["END"], 0, 0, 0, 0, 0))
        sizes = [self.function.nnz_in(i) for i in range(self.function.n_in())]
        lengths = [self.function.nnz_out(i) for i in range(self.function.n_out())]
        if max([slots, len(self.constants), *sizes, *lengths]) >= MOST:
            raise ModelError(f"an expression of {len(rows)} operations is too large for a tape")
        return Tape(
            instructions=np.array(rows, dtype=np.uint16),
            constants=np.array([*self.constants, 0.0]),
            slots=slots,
            lengths=np.array(lengths, dtype=np.int64),
        )
