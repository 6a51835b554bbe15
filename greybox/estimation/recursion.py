"""Recursion: the step of an `Engine` over the samples of a record, with its sensitivities.

The same recursion is written twice: `Compiled` is a small hand-written loop in C (driver.c) around
the step as C and its derivatives as tapes; `Interpreted` is NumPy around the same functions in
CasADi's VM, where there is no C compiler. Both give the same numbers.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import casadi as ca
import numpy as np
import numpy.typing as npt

from greybox.estimation.tape import Linear
from greybox.symbolic import CHUNK, BoolArray, FloatArray, OnArrays, mapped

IntArray = npt.NDArray[np.int32]
Rows = npt.NDArray[np.int_]
Pointer = object
"""Memory as ctypes hands it to C."""


@dataclass(frozen=True, kw_only=True)
class Sizes:
    """How many states, error states, innovations, outputs and inputs a step has, and how many rows
    of inputs its `window` sees."""

    states: int
    errors: int
    innovations: int
    outputs: int
    inputs: int
    window: int


@dataclass(frozen=True, kw_only=True)
class GainTable:
    """Correction per pattern of missing channels: gain (n_pat, n_d, n_e), its derivative per
    pattern (n_k, n_d, n_e), or None, in the columns `moving` (n_k, ascending) of the sensitivities;
    None for the first n_k.

    `zero[i]` true: pattern i corrects nothing (pure simulation).
    """

    gain: FloatArray
    zero: IntArray
    derivative: tuple[FloatArray, ...] | None = None
    moving: IntArray | None = None

    def moved_columns(self) -> IntArray:
        """Columns of the sensitivities that the derivative is in, (n_k,)."""
        if self.moving is not None:
            return np.ascontiguousarray(self.moving, dtype=np.int32)
        return np.arange(len(self.derivative[0]) if self.derivative else 0, dtype=np.int32)


@dataclass(frozen=True, kw_only=True, eq=False)
class Pass:
    """One pass as the recursion takes it: contiguous arrays, of which x (n_x,), s (n_d, n_s) and
    those in `out` are written. Arrays that are not kept are None."""

    x: FloatArray
    s: FloatArray | None
    u: FloatArray
    y: FloatArray
    mask: FloatArray
    pattern: IntArray
    gains: GainTable
    p: FloatArray
    dt: float
    out: dict[str, FloatArray | None]

    @property
    def n(self) -> int:
        """Number of samples."""
        return self.y.shape[0]

    @property
    def ns(self) -> int:
        """Number of columns of the sensitivities, 0 without them."""
        return 0 if self.s is None else self.s.shape[1]


@dataclass(frozen=True, kw_only=True, eq=False)
class OpenRuns:
    """Many short open-loop runs as the recursion takes them: contiguous arrays, of which x (m,
    n_x), s (m, n_d, n_s), e (r, n_e) and de (r, n_e, n_s) are written. `asked` (of the longest run):
    which of its steps are kept, None for all."""

    first: IntArray
    length: IntArray
    tail: IntArray
    asked: IntArray | None
    x: FloatArray
    s: FloatArray | None
    u: FloatArray
    y: FloatArray
    mask: FloatArray
    p: FloatArray
    dt: float
    e: FloatArray
    de: FloatArray | None


@dataclass(frozen=True, kw_only=True, eq=False)
class Rollout:
    """Many open-loop runs of one length from the states `starts` (m, n_x) at the `rows` (m,) of the
    inputs u: contiguous arrays, of which y (m, horizon, n_y) and states (m, horizon, n_x), if
    any, are written."""

    starts: FloatArray
    rows: IntArray
    u: FloatArray
    p: FloatArray
    dt: float
    y: FloatArray
    states: FloatArray | None


class Recursion(Protocol):
    """What carries a step over samples."""

    def run(self, one: Pass) -> int:
        """Filter the samples of one pass: 0, or one more than the sample behind which the numbers
        stopped being finite."""
        ...

    def windows(self, runs: OpenRuns) -> int:
        """Carry out open-loop runs: 0, or one more than the first that stopped being finite."""
        ...

    def rollout(self, runs: Rollout) -> None:
        """Carry out open-loop runs without sensitivities."""
        ...


@dataclass(frozen=True, kw_only=True, eq=False)
class Compiled:
    """The recursion of driver.c in a `library` beside a model's step; `slope` and `turn` are the
    tapes of its derivatives, `place` the column of each parameter that these were built for, -1
    where it is not carried (None: all are, in order)."""

    library: ctypes.CDLL
    sizes: Sizes
    slope: Linear
    turn: Linear
    place: IntArray | None = None

    def __post_init__(self) -> None:
        self.library.gb_buffer.restype = ctypes.c_longlong

    def run(self, one: Pass) -> int:
        """As `Recursion` says."""
        z, ns, gains, out = self.sizes, one.ns, one.gains, one.out
        slopes = [np.ascontiguousarray(v) for v in gains.derivative or ()] if ns else []
        moving = gains.moved_columns()
        nk = len(slopes[0]) if slopes else 0
        arg, res, iw, w, buffer = self._scratch(nk)
        gain = np.ascontiguousarray(gains.gain)
        zero = np.ascontiguousarray(gains.zero, dtype=np.int32)
        pointers = (ctypes.c_void_p * len(slopes))(*(v.ctypes.data for v in slopes)) if nk else None
        return int(
            self.library.gb_run(
                one.n,
                z.states,
                z.errors,
                z.innovations,
                z.outputs,
                z.inputs,
                ns,
                nk,
                *self._tapes,
                _ptr(one.x),
                _ptr(one.s),
                _ptr(one.u),
                _ptr(one.y),
                _ptr(one.mask),
                _ptr(one.pattern),
                _ptr(one.p),
                ctypes.c_double(one.dt),
                _ptr(gain),
                _ptr(zero),
                pointers,
                _ptr(moving),
                _ptr(out["states"]),
                _ptr(out["innovations"]),
                _ptr(out["outputs"]),
                _ptr(out["sensitivity"]),
                _ptr(out["state_sensitivity"]),
                _ptr(self.place),
                arg,
                res,
                iw,
                w,
                _ptr(buffer),
            )
        )

    def windows(self, runs: OpenRuns) -> int:
        """As `Recursion` says."""
        z, ns = self.sizes, 0 if runs.s is None else runs.s.shape[2]
        arg, res, iw, w, buffer = self._scratch()
        return int(
            self.library.gb_windows(
                len(runs.first),
                _ptr(runs.first),
                _ptr(runs.length),
                _ptr(runs.tail),
                _ptr(runs.asked),
                z.states,
                z.errors,
                z.innovations,
                z.outputs,
                z.inputs,
                ns,
                *self._tapes,
                _ptr(runs.x),
                _ptr(runs.s),
                _ptr(runs.u),
                _ptr(runs.y),
                _ptr(runs.mask),
                _ptr(runs.p),
                ctypes.c_double(runs.dt),
                _ptr(runs.e),
                _ptr(runs.de),
                _ptr(self.place),
                arg,
                res,
                iw,
                w,
                _ptr(buffer),
            )
        )

    def rollout(self, runs: Rollout) -> None:
        """As `Recursion` says."""
        z, horizon = self.sizes, runs.y.shape[1]
        arg, res, iw, w, buffer = self._scratch()
        self.library.gb_rollout(
            len(runs.rows),
            horizon,
            z.states,
            z.outputs,
            z.inputs,
            _ptr(runs.starts),
            _ptr(runs.rows),
            _ptr(runs.u),
            _ptr(runs.p),
            ctypes.c_double(runs.dt),
            _ptr(runs.y),
            _ptr(runs.states),
            arg,
            res,
            iw,
            w,
            _ptr(buffer),
        )

    def _scratch(self, nk: int = 0) -> tuple[Pointer, Pointer, Pointer, Pointer, FloatArray]:
        a, r, i, w = (ctypes.c_longlong() for _ in range(4))
        self.library.gb_sizes(*(ctypes.byref(v) for v in (a, r, i, w)))
        z = self.sizes
        sizes = z.states, z.errors, z.innovations, z.outputs, nk
        length = int(self.library.gb_buffer(*sizes, *self._tapes))
        return (
            (ctypes.c_void_p * a.value)(),
            (ctypes.c_void_p * r.value)(),
            (ctypes.c_longlong * i.value)(),
            (ctypes.c_double * w.value)(),
            np.empty(length),
        )

    @property
    def _tapes(self) -> tuple[Pointer, Pointer]:
        return ctypes.byref(self.slope.carrier), ctypes.byref(self.turn.carrier)


@dataclass(frozen=True, kw_only=True, eq=False)
class Interpreted:
    """The recursion in NumPy around an engine's functions in CasADi's VM: `value` the step with
    innovation and outputs, `inject` a correction, `pred` the step alone, `slope` gives the
    derivatives, which are made when they are first asked for. `columns` (n_a,) are those of the
    parameters that are carried."""

    sizes: Sizes
    value: ca.Function
    inject: ca.Function
    pred: ca.Function
    slope: Callable[[], ca.Function]
    columns: npt.NDArray[np.int_]

    def run(self, one: Pass) -> int:
        """As `Recursion` says."""
        x, s, u, mask, gains = one.x, one.s, one.u, one.mask, one.gains
        width = self.sizes.window
        na = len(self.columns)
        step, inject = OnArrays(self.value), OnArrays(self.inject)
        slopes = None if s is None else OnArrays(self.slope())
        for t in range(one.n):
            at = (x, u[t : t + width].ravel(), one.y[t], one.p, one.dt)
            xf, e, yh = (v.ravel() for v in step(*at))
            e = e * (mask[t] != 0)
            for key, value in (("states", x), ("innovations", e), ("outputs", yh)):
                if (kept := one.out[key]) is not None:
                    kept[t] = value
            if s is not None and slopes is not None:
                if (kept := one.out["state_sensitivity"]) is not None:
                    kept[t] = s
                a, b, ex, ep = slopes(*at)
                de = ex @ s
                de[:, :na] += ep[:, self.columns]
                de *= (mask[t] != 0)[:, None]
                if (kept := one.out["sensitivity"]) is not None:
                    kept[t] = de
                moved = a @ s
                moved[:, :na] += b[:, self.columns]
            g = int(one.pattern[t])
            if gains.zero[g]:
                x[:] = xf
                if s is not None:
                    s[:] = moved
            else:
                xn, j1, j2 = inject(xf, gains.gain[g] @ e)
                x[:] = xn.ravel()
                if s is not None:
                    push = gains.gain[g] @ de
                    if gains.derivative is not None:
                        slope = gains.derivative[g]
                        push[:, gains.moved_columns()] += (slope @ e).T
                    s[:] = j1 @ moved + j2 @ push
            if not np.isfinite(x).all():
                return 1 + t
        return 0

    def windows(self, runs: OpenRuns) -> int:
        """As `Recursion` says: many runs together, a sample at a time; one that stops being finite
        is left where it was."""
        step = np.arange(runs.length.max(initial=0))
        wanted = step >= (runs.length - runs.tail)[:, None]
        wanted &= step < runs.length[:, None]
        if runs.asked is not None:
            wanted &= runs.asked != 0
        # Where the innovations of each run and sample go: in the order of both.
        place = np.where(wanted, np.cumsum(wanted).reshape(wanted.shape) - 1, -1)
        well = np.ones(len(runs.first), dtype=bool)
        for first in range(0, well.size, CHUNK):  # all of them together are too much memory
            some = np.arange(first, min(first + CHUNK, well.size))
            for t in step.tolist():
                live = some[(runs.length[some] > t) & well[some]]
                if live.size:
                    well[live] = self._one_sample(runs, live, t, place[live, t])
        return 0 if well.all() else 1 + int(np.argmin(well))

    def _one_sample(self, runs: OpenRuns, live: Rows, t: int, into: Rows) -> BoolArray:
        """Sample t of the runs `live` (m,), whose innovations go `into` (m,) these rows, -1 for
        nowhere; whether they are finite after it."""
        rows, m, keep = runs.first[live] + t, live.size, into >= 0
        na = len(self.columns)
        at = (
            runs.x[live].T,
            self._inputs(runs.u, rows),
            runs.y[rows].T,
            np.repeat(runs.p[:, None], m, axis=1),
            np.full((1, m), runs.dt),
        )
        after, e, _ = (v.full().T for v in mapped(self.value, m)(*at))
        seen = runs.mask[rows] != 0
        runs.e[into[keep]] = (e * seen)[keep]
        if runs.s is not None and runs.de is not None:
            s = runs.s[live]
            a, b, ex, ep = (
                v.full().reshape(v.shape[0], m, -1).transpose(1, 0, 2)
                for v in mapped(self.slope(), m)(*at)
            )
            de, moved = ex @ s, a @ s
            de[:, :, :na] += ep[:, :, self.columns]
            moved[:, :, :na] += b[:, :, self.columns]
            runs.de[into[keep]] = (de * seen[:, :, None])[keep]
            runs.s[live] = moved
        runs.x[live] = after
        return np.asarray(np.isfinite(after).all(axis=1))

    def rollout(self, runs: Rollout) -> None:
        """As `Recursion` says."""
        m, horizon = runs.y.shape[:2]
        step, x = mapped(self.pred, m), runs.starts.T
        for h in range(horizon):
            p, dt = np.repeat(runs.p[:, None], m, 1), np.full((1, m), runs.dt)
            after, yh = step(x, self._inputs(runs.u, runs.rows + h), p, dt)
            runs.y[:, h] = yh.full().T
            if runs.states is not None:
                runs.states[:, h] = np.asarray(x).T
            x = after.full()

    def _inputs(self, u: FloatArray, rows: IntArray | Rows) -> FloatArray:
        """What the window sees at these rows (m,) of a record, beside each other: (n_u, m times its
        width)."""
        seen = u[rows[:, None] + np.arange(self.sizes.window)]
        return np.asarray(
            seen.transpose(2, 0, 1).reshape(u.shape[1], len(rows) * self.sizes.window)
        )


def _ptr(array: npt.NDArray[np.generic] | None) -> Pointer:
    return None if array is None else array.ctypes.data_as(ctypes.c_void_p)
