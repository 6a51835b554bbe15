"""Tapes: straight-line expressions as numbers, which `tape.c` runs for many samples at once.

Once the states of a record are known, the linearisations of its steps do not depend on each other.
An interpreter that takes one instruction for 32 samples spends little on reading it, and the
numbers stay in the processor's vectors. It is quicker than compiled code of the same expression
without optimisation, and nothing has to be compiled: expressions of tens of thousands of operations
take the compiler seconds.

A product that is added once, and used nowhere else, is one instruction with its sum. `write_tape.c`
puts the instructions into an order.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources

import casadi as ca
import numpy as np
import numpy.typing as npt

from greybox.errors import ModelError
from greybox.estimation.build import DRIVER_FLAGS, opened
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
"""Names of the instructions, in the order of tape.c and write_tape.c; but for the first and those
with two parts CasADi's own."""
CODE = {name: i for i, name in enumerate(ORDER)}
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

    def at_points(self, library: ctypes.CDLL, *arguments: npt.ArrayLike) -> list[FloatArray]:
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
    def from_arrays(cls, arrays: Mapping[str, npt.NDArray[np.generic]]) -> Linear:
        """Inverse of `arrays`."""
        tape = Tape(
            instructions=np.asarray(arrays["instructions"], dtype=np.uint16),
            constants=np.asarray(arrays["constants"], dtype=np.float64),
            slots=int(arrays["slots"].item()),
            lengths=np.asarray(arrays["lengths"], dtype=np.int64),
        )
        many = sum(name.startswith("sparsity") for name in arrays)
        return cls(tape, [np.asarray(arrays[f"sparsity{i}"], dtype=np.int64) for i in range(many)])


@functools.cache
def tape_library() -> ctypes.CDLL | None:
    """What writes and runs tapes, compiled; None without a compiler."""
    own = resources.files("greybox.estimation")
    texts = {n: own.joinpath(f"{n}.c").read_text(encoding="utf-8") for n in ("tape", "write_tape")}
    library = opened([(f"gb_{n}.c", text, DRIVER_FLAGS) for n, text in texts.items()])
    if library is not None:
        library.gb_tape.restype = None
    return library


def tape_of(function: ca.Function) -> Tape:
    """The tape of a CasADi function of SX expressions, where there is a compiler. Raises
    `ModelError` for an operation that has none, and for a function that is too large."""
    n, names = function.n_instructions(), operation_names()
    codes = [CODE.get(names[function.instruction_id(k)], -1) for k in range(n)]
    if -1 in codes:
        name = names[function.instruction_id(codes.index(-1))]
        raise ModelError(f"the expression uses the operation {name}, which has no tape")
    code = np.array(codes, dtype=np.int32)
    made, given = (
        np.array([(*ask(k), -1, -1)[:2] for k in range(n)], dtype=np.int32).reshape(n, 2)
        for ask in (function.instruction_output, function.instruction_input)
    )
    constant = np.flatnonzero(code == CODE["CONST"])
    given[constant] = np.column_stack([np.arange(constant.size), np.zeros(constant.size)])
    sizes = [function.nnz_in(i) for i in range(function.n_in())]
    lengths = [function.nnz_out(i) for i in range(function.n_out())]
    rows, slots = np.zeros((n + 1, 6), dtype=np.uint16), ctypes.c_int()
    if max([constant.size, *sizes, *lengths]) < MOST:
        held = int(made.max(initial=0)) + 1
        arrays = [ctypes.c_void_p(v.ctypes.data) for v in (code, made, given, rows)]
        library = tape_library()
        assert library is not None
        many = library.gb_write_tape(n, held, CHUNK, *arrays, ctypes.byref(slots))
        if many < 0:
            raise MemoryError(f"a tape of {n} operations")
        rows = rows[:many]
    if max([slots.value, constant.size, *sizes, *lengths]) >= MOST:
        raise ModelError(f"an expression of {n} operations is too large for a tape")
    return Tape(
        instructions=rows,
        constants=np.array([*map(function.instruction_constant, constant.tolist()), 0.0]),
        slots=slots.value,
        lengths=np.array(lengths, dtype=np.int64),
    )
