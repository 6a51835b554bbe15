"""The seam to CasADi: named layouts, safe norms, smooth switches, and evaluation over many samples.

CasADi has no type stubs; `Expr` stands for an SX or MX expression everywhere else in greybox.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from greybox.errors import ModelError, UnknownNameError
from greybox.instructions import FEWEST, carried_out

Expr = Any
Namespace = ModuleType
"""`numpy` or `casadi`: what both can compute is written once, for arrays and for expressions."""
CHUNK = 1024
"""Samples that one call of a mapped function takes."""
CASADI = threading.RLock()
"""Held by whoever builds or evaluates CasADi expressions where other threads may: CasADi lets go of
Python's lock, and not every build of it counts references safely across threads."""
FloatArray = npt.NDArray[np.float64]
Numeric = Expr | FloatArray
"""What a function computes with that takes a `Namespace`."""
BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class Signal:
    """One scalar of a vector: its name, its unit (SI string) and what it means."""

    name: str
    unit: str
    meaning: str = ""


@functools.cache
def operation_names() -> Mapping[int, str]:
    """CasADi's names of its operations by their codes, which change between its versions."""
    return {
        getattr(ca, n): n.removeprefix("OP_")
        for n in sorted(dir(ca), reverse=True)
        if n.startswith("OP_")
    }


def given(value: Expr) -> tuple[Expr, ...]:
    """It as a further argument; none where it is None."""
    return () if value is None else (value,)


def sum_of(first: Expr, second: Expr) -> Expr:
    """Their sum, where None is nothing."""
    if first is None or second is None:
        return second if first is None else first
    return first + second


Rates = Callable[[Mapping[str, Expr], Expr], dict[str, Expr]]
"""Derivatives of named blocks of states, of these blocks and one more vector."""


def written_once(rates: Rates, blocks: Mapping[str, Expr], more: Expr) -> Rates:
    """The same `rates`, where expressions (SX) of the shapes of `blocks` and `more` are put into
    what was written for the first of them: that takes a hundredth of the time of writing it again.
    """
    like = [*blocks.values(), more]
    if not all(isinstance(v, ca.SX) for v in like):
        return rates
    free = [ca.SX.sym("at", *v.shape) for v in like]
    made = rates(dict(zip(blocks, free, strict=False)), free[-1])

    def put_in(states: Mapping[str, Expr], last: Expr) -> dict[str, Expr]:
        given = [ca.densify(ca.SX(v)) for v in (*(states[b] for b in blocks), last)]
        found = ca.substitute([ca.SX(v) for v in made.values()], free, given)
        return dict(zip(made, found, strict=True))

    return put_in


class Layout:
    """An ordered set of named scalar signals: maps names to positions in a vector.

    Immutable. `layout["omega.x"]` is the index; iteration gives the signals. Raises
    `UnknownNameError` for a name that is not there, and `ModelError` for a name that is there
    twice.

    >>> rates = Layout([Signal(name="p", unit="rad/s"), Signal(name="q", unit="rad/s")])
    >>> rates["q"], rates.names
    (1, ('p', 'q'))
    """

    __slots__ = ("_index", "signals")

    def __init__(self, signals: Sequence[Signal]) -> None:
        self.signals = tuple(signals)
        self._index = {s.name: i for i, s in enumerate(self.signals)}
        if len(self._index) != len(self.signals):
            names = [s.name for s in self.signals]
            double = sorted({n for n in names if names.count(n) > 1})
            raise ModelError(f"signal names given twice: {', '.join(double)}")

    @property
    def names(self) -> tuple[str, ...]:
        """The names in order."""
        return tuple(self._index)

    @property
    def units(self) -> tuple[str, ...]:
        """The units in order."""
        return tuple(s.unit for s in self.signals)

    def __len__(self) -> int:
        return len(self.signals)

    def __iter__(self) -> Iterator[Signal]:
        return iter(self.signals)

    def __contains__(self, name: object) -> bool:
        return name in self._index

    def __getitem__(self, name: str) -> int:
        try:
            return self._index[name]
        except KeyError:
            raise UnknownNameError("signal", name, self._index) from None

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Layout) and self.signals == other.signals

    def __hash__(self) -> int:
        return hash(self.signals)

    def __repr__(self) -> str:
        return f"Layout({', '.join(self.names)})"

    def __add__(self, other: Layout) -> Layout:
        return Layout((*self.signals, *other.signals))


def safe_norm(v: Expr, eps: float = 1e-12) -> Expr:
    """Euclidean norm that is differentiable at zero: sqrt(v.v + eps^2) - eps, exactly 0 at v =
    0."""
    return ca.sqrt(ca.sumsqr(v) + eps * eps) - eps


def evaluate(function: ca.Function, *columns: npt.ArrayLike) -> FloatArray:
    """Evaluate a single-output CasADi function over many samples, time first.

    Each argument is an array (N, n_i) (or (n_i,) for a value that all samples share); the result is
    (N, n_out). Raises `ModelError` for arrays of different length.
    """
    arrays = [np.asarray(c, dtype=np.float64) for c in columns]
    lengths = {a.shape[0] for a in arrays if a.ndim == 2}
    if len(lengths) > 1:
        raise ModelError(f"arrays of different length: {sorted(lengths)}")
    n = lengths.pop() if lengths else 1
    if n == 0:
        return np.zeros((0, function.size1_out(0)))
    wide = [
        np.ascontiguousarray(a if a.ndim == 2 else np.broadcast_to(a.ravel(), (n, a.size)))
        for a in arrays
    ]
    dense = (
        all(function.sparsity_in(i).is_dense() for i in range(len(wide)))
        and function.sparsity_out(0).is_dense()
    )
    if not dense or any(a.shape[1] != function.numel_in(i) for i, a in enumerate(wide)):
        return np.asarray(function.map(n)(*(a.T for a in wide)).full(), dtype=np.float64).T
    out = np.zeros((n, function.numel_out(0)))
    if n >= FEWEST and carried_out(function, wide, out):
        return out
    for at in range(0, n, CHUNK):
        size = min(CHUNK, n - at)
        # The function reads and writes the arrays where they are: columns of CasADi are rows here.
        buffer, run = mapped(function, size).buffer()
        for i, a in enumerate(wide):
            buffer.set_arg(i, a[at : at + size].data)
        buffer.set_res(0, out[at : at + size].data)
        run()
    return out


@functools.lru_cache(maxsize=64)
def mapped(function: ca.Function, n: int) -> Expr:
    """A function of n samples beside each other; what was made before is known."""
    return function.map(n)


class OnArrays:
    """A function of CasADi's VM with arrays of its own for what goes in and out, which a call does
    not make anew: a sample at a time, that is most of what a small step costs.

    Takes vectors, matrices column by column; returns matrices that hold until the next call.
    """

    def __init__(self, function: ca.Function) -> None:
        self._buffer: Expr
        self._buffer, self._evaluate = function.buffer()
        self._given: list[FloatArray] = []
        for i in range(function.n_in()):
            own = np.zeros(max(function.nnz_in(i), 1))
            self._buffer.set_arg(i, own.data)
            self._given.append(own[: function.nnz_in(i)])
        self._results: list[FloatArray] = []
        self._stored: list[tuple[FloatArray, FloatArray, IntArray]] = []
        for i in range(function.n_out()):
            pattern = function.sparsity_out(i)
            whole = np.zeros(max(pattern.numel(), 1))
            stored = whole if pattern.is_dense() else np.zeros(max(pattern.nnz(), 1))
            self._buffer.set_res(i, stored.data)
            if stored is not whole:
                place = np.array(pattern.find(), dtype=np.int64)
                self._stored.append((stored, whole, place))
            self._results.append(whole[: pattern.numel()].reshape(pattern.shape, order="F"))

    def __call__(self, *given: npt.ArrayLike) -> list[FloatArray]:
        """The results at these arguments."""
        for own, value in zip(self._given, given, strict=True):
            own[:] = value
        self._evaluate()
        for stored, whole, place in self._stored:
            whole[place] = stored[: place.size]
        return self._results
