"""Engine: one step of a Dynamics with its exact sensitivities, compiled to C, and the recursions
over a record.

The step is linearised symbolically in the error state (SX, sparse). The step itself is generated as
C, its linearisation is a tape (`greybox.estimation.tape`); both are driven by a small hand-written
loop (driver.c) that carries the sensitivities S = d(error state)/d(parameters). Without a C
compiler the same functions run in CasADi's VM under the same recursion in NumPy: the same numbers,
slower.
"""

from __future__ import annotations

import ctypes
import functools
from dataclasses import dataclass
from importlib import resources
from typing import TypedDict, Unpack

import casadi as ca
import numpy as np
import numpy.typing as npt

from greybox.errors import FitError, ModelError, UnknownNameError
from greybox.estimation.build import DRIVER_FLAGS, MODEL_FLAGS, compiler, opened
from greybox.estimation.cache import say
from greybox.estimation.reference_point import chart_jacobians, reference_step, symbols
from greybox.estimation.tape_cache import linears
from greybox.model.dynamics import Dynamics
from greybox.symbolic import CASADI, FloatArray, evaluate

IntArray = npt.NDArray[np.int32]
Whole = npt.NDArray[np.int32 | np.int64]
"""Whole numbers of any size."""
Pointer = object
"""Memory as ctypes hands it to C."""


@dataclass(frozen=True, kw_only=True)
class Run:
    """What a pass over n samples gives; arrays that were not asked for are None.

    states (n, n_x) predicted before the sample's correction, innovations (n, n_e), outputs (n, n_y)
    predicted, sensitivity (n, n_e, n_s) of the innovations, state_sensitivity (n, n_d, n_s), end
    (n_x,), end_sensitivity (n_d, n_s).
    """

    states: FloatArray | None
    innovations: FloatArray | None
    outputs: FloatArray | None
    sensitivity: FloatArray | None
    state_sensitivity: FloatArray | None
    end: FloatArray
    end_sensitivity: FloatArray | None
    failed_at: int | None

    def demand_finite(self, what: str, before: int = 0) -> None:
        """Raise `FitError` where the numbers of `what` stopped being finite, at a sample that is
        counted from `before` these n."""
        if self.failed_at is not None:
            raise FitError(f"{what} is not finite after sample {before + self.failed_at}")


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


class Samples(TypedDict):
    """The samples of one record, as keywords of `Engine.run` and `Engine.windows`: `inputs` padded
    by `padded_inputs`, outputs (n, n_y; NaN where missing), mask (n, n_e), dt [s]."""

    inputs: FloatArray
    outputs: FloatArray
    mask: FloatArray
    dt: float


@dataclass(frozen=True, kw_only=True, eq=False)
class _Pass:
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
class _OpenRuns:
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


@dataclass(frozen=True, kw_only=True)
class Windows:
    """What many short open-loop runs give: innovations (r, n_e) and their sensitivity (r, n_e, n_s)
    of the kept samples, ends (m, n_x) and end_sensitivity (m, n_d, n_s); failed_in is the first
    window that stopped being finite."""

    innovations: FloatArray
    sensitivity: FloatArray | None
    ends: FloatArray
    end_sensitivity: FloatArray | None
    failed_in: int | None


class Engine:
    """Compiled (or VM) step of `dynamics` with sensitivities for the parameters named in `active`.

    `compiled` says which of the two it is. Engines are cached per model structure by `engine_for`.
    One that is not `sensitive` runs without sensitivities only: a large model is then built several
    times quicker. `built` are the parameters that sensitivities were built for, of which `active`
    are carried: the ones at `columns` (see `select`).
    """

    def __init__(
        self,
        dynamics: Dynamics,
        active: tuple[str, ...],
        *,
        use_compiler: bool = True,
        sensitive: bool = True,
    ) -> None:
        self.use_compiler = use_compiler
        with CASADI:
            self.dynamics = dynamics
            self.active = active
            self.sensitive = sensitive
            self.nx, self.nd = len(dynamics.states), len(dynamics.error_states)
            self.ne, self.ny, self.nu = (
                len(dynamics.innovations),
                len(dynamics.outputs),
                len(dynamics.inputs),
            )
            self.past, self.future = dynamics.window
            names = [p.name for p in dynamics.parameters]
            self.active_index = np.array([names.index(a) for a in active], dtype=int)
            self._place: IntArray | None = None
            self.built, self.columns = active, np.arange(len(active))
            self._functions()
        self._library: ctypes.CDLL | None = None
        if use_compiler and compiler() is not None:
            self._compile()

    def __reduce__(self) -> tuple[object, ...]:
        """What is compiled stays in its process: another one builds it again, from the cache."""
        built = self.dynamics, self.built, self.active, self.use_compiler, self.sensitive
        return _built_again, built

    def select(self, active: tuple[str, ...]) -> Engine:
        """The same engine with the sensitivities of some of its parameters only: nothing is built
        again.

        Raises `UnknownNameError` for a parameter that this engine has no sensitivity of.
        """
        if active == self.active:
            return self
        for a in active:
            if a not in self.active:
                raise UnknownNameError("active parameter", a, self.active)
        some = object.__new__(Engine)
        vars(some).update(vars(self))
        some.active = active
        at = np.array([self.active.index(a) for a in active], dtype=int)
        some.columns, some.active_index = self.columns[at], self.active_index[at]
        some._place = np.full(len(self.built), -1, dtype=np.int32)
        some._place[some.columns] = np.arange(len(active))
        return some

    @property
    def compiled(self) -> bool:
        """Whether the step runs as compiled C."""
        return self._library is not None

    @property
    def _c(self) -> ctypes.CDLL:
        assert self._library is not None
        return self._library

    def _functions(self) -> None:
        d, at = self.dynamics, reference_step(self.dynamics, ())
        x, window, p, dt, y = at.x, at.window, at.p, at.dt, at.measured
        w0 = ca.DM.zeros(len(d.noises))
        # What is written once is differentiated once.
        after, y_hat, e, into, out = ca.cse(at.whole.call([x, window, p, w0, y, dt]))
        inputs = [x, window, y, p, dt]
        self.value = ca.Function("gb_value", inputs, [ca.densify(v) for v in (after, e, y_hat)])
        self._stepped = ca.Function("gb_stepped", inputs, [after, e, y_hat, into, out])
        self.pred = ca.Function(
            "gb_pred", [x, window, p, dt], [ca.densify(after), ca.densify(y_hat)]
        )
        z, k = ca.SX.sym("xF", self.nx), ca.SX.sym("k", self.nd)
        moved = d.boxplus(z, k)
        z_into, moved_out = chart_jacobians(d, z, moved)
        j1 = ca.sparsify(moved_out @ ca.jacobian(moved, z) @ z_into)
        j2 = ca.sparsify(moved_out @ ca.jacobian(moved, k))
        self.inject = ca.Function("gb_inject", [z, k], [ca.densify(moved), j1, j2])
        self.move = ca.Function("gb_move", [z, k], [ca.densify(moved)])
        self.turn = ca.Function("gb_turn", [z, k], [j1, j2])

    @functools.cached_property
    def slope(self) -> ca.Function:
        """x, U, y, p, dt -> dxF/dx, dxF/dp, de/dx, de/dp in the error state; p are those that
        sensitivities were built for."""
        with CASADI:
            inputs = self._stepped.sx_in()
            x, _, _, p, _ = inputs
            after, e, _, into, out = self._stepped.call(inputs)
            chosen = [[d.name for d in self.dynamics.parameters].index(n) for n in self.built]
            if self.sensitive:
                a = ca.sparsify(out @ ca.jacobian(after, x) @ into)
                b = ca.sparsify(out @ ca.jacobian(after, p)[:, chosen])
                ex = ca.sparsify(ca.jacobian(e, x) @ into)
                ep = ca.sparsify(ca.jacobian(e, p)[:, chosen])
            else:
                a, b = ca.SX(self.nd, self.nd), ca.SX(self.nd, len(chosen))
                ex, ep = ca.SX(self.ne, self.nd), ca.SX(self.ne, len(chosen))
            return ca.Function("gb_slope", inputs, [a, b, ex, ep])

    def _compile(self) -> None:
        with CASADI:
            generator = ca.CodeGenerator("gb_model.c", {"with_header": False})
            for f in (self.value, self.move):
                generator.add(f)
            text = generator.dump()
            del generator
        own = resources.files("greybox.estimation")
        written = {
            n: own.joinpath(f"{n}.c").read_text(encoding="utf-8") for n in ("driver", "tape")
        }
        library = opened(
            [
                ("gb_model.c", text, MODEL_FLAGS),
                *((f"gb_{n}.c", t, DRIVER_FLAGS) for n, t in written.items()),
            ]
        )
        if library is None:
            return
        names = [d.name for d in self.dynamics.parameters]
        try:
            with CASADI:
                found = linears(
                    self._stepped,
                    f"{self.built} of {names}, sensitive: {self.sensitive}; {self.move.serialize()}",
                    {"slope": lambda: self.slope, "turn": lambda: self.turn},
                )
                self._slope, self._turn = found["slope"], found["turn"]
        except ModelError as error:
            say(f"{error}; CasADi's VM runs the same equations, slower")
            return
        library.gb_buffer.restype = ctypes.c_longlong
        sizes = [ctypes.c_longlong() for _ in range(4)]
        library.gb_sizes(*(ctypes.byref(v) for v in sizes))
        self._work = [v.value for v in sizes]
        self._library = library

    def moved(self, x: FloatArray, d: FloatArray) -> tuple[FloatArray, FloatArray]:
        """x (n_x,) moved by an error d (n_d,), and the derivative in d, (n_d, n_d), in the chart of
        the moved state."""
        with CASADI:
            state, _, slope = (v.full() for v in self.inject(x, d))
        return np.asarray(state).ravel(), np.asarray(slope)

    @functools.cached_property
    def _unexpected(self) -> tuple[ca.Function, ca.Function]:
        """x, y -> innovation of readings that are the outputs y, and its slope in the readings."""
        d = self.dynamics
        with CASADI:
            x, y, told = (
                ca.SX.sym(n, k) for n, k in (("x", self.nx), ("y", self.ny), ("h", self.ny))
            )
            e = d.innovation(y, told, x)
            by = ca.jacobian(e, y)
            inputs = [x, told]
            e, by = (ca.substitute(v, y, told) for v in (e, by))
            return (
                ca.Function("unexpected", inputs, [ca.densify(e)]),
                ca.Function("by_readings", inputs, [ca.densify(ca.vec(by.T))]),
            )

    def expected(self, states: FloatArray, outputs: FloatArray) -> FloatArray:
        """Readings (m, n_y) that sensors in `states` (m, n_x) are expected to show where the craft's
        outputs are `outputs` (m, n_y): those without innovation. Errors of a sensor that are states
        are in its readings and in no output. A sensor's innovation is linear in its reading."""
        error, slope = self._unexpected
        e = evaluate(error, states, outputs)
        if not e.any():
            return outputs
        by = evaluate(slope, states, outputs).reshape(len(states), self.ne, self.ny)
        across = by @ by.transpose(0, 2, 1)
        step = by.transpose(0, 2, 1) @ np.linalg.solve(across, -e[:, :, None])
        return np.asarray(outputs + step[:, :, 0])

    def padded_inputs(self, u: FloatArray, earlier: FloatArray | None = None) -> FloatArray:
        """Record of commands (n, n_u) with what the window sees besides: (n + past + future, n_u).

        Before it stand the commands `earlier` (m, n_u) as far as they go, then the first row; after
        it the last row.
        """
        u = np.asarray(u, dtype=np.float64)
        if not (self.past or self.future):
            return np.ascontiguousarray(u)
        known = (
            u[:0]
            if earlier is None or not self.past
            else np.asarray(earlier, dtype=np.float64)[-self.past :]
        )
        first = (known if len(known) else u)[:1]
        rows = [
            np.repeat(first, self.past - len(known), 0),
            known,
            u,
            np.repeat(u[-1:], self.future, 0),
        ]
        return np.ascontiguousarray(np.concatenate(rows))

    def run(
        self,
        *,
        x0: FloatArray,
        gains: GainTable,
        pattern: IntArray,
        p: FloatArray,
        s0: FloatArray | None = None,
        want: frozenset[str] = frozenset({"innovations"}),
        **samples: Unpack[Samples],
    ) -> Run:
        """Filter n samples from x0 (n_x,) with the parameters p (n_p) and that one of the `gains`
        that `pattern` (n,) says. inputs, outputs, mask, dt: see `Samples`.

        `want` names the arrays of `Run` to keep. With `s0` (n_d, n_s) the sensitivities run along:
        the first columns belong to the active parameters, the others only to what s0 and the gain's
        derivative put there.
        """
        outputs = samples["outputs"]
        n = outputs.shape[0]
        ns = 0 if s0 is None else s0.shape[1]
        shapes = {
            "states": (n, self.nx),
            "innovations": (n, self.ne),
            "outputs": (n, self.ny),
            "sensitivity": (n, self.ne, ns),
            "state_sensitivity": (n, self.nd, ns),
        }
        out = {
            k: (np.zeros(v) if k in want and (ns or "sens" not in k) else None)
            for k, v in shapes.items()
        }
        one = _Pass(
            x=np.array(x0, dtype=np.float64),
            s=None if s0 is None else np.array(s0, dtype=np.float64, order="C"),
            u=np.ascontiguousarray(samples["inputs"]),
            y=np.ascontiguousarray(np.where(np.isfinite(outputs), outputs, 0.0)),
            mask=np.ascontiguousarray(samples["mask"], dtype=np.float64),
            pattern=np.ascontiguousarray(pattern, dtype=np.int32),
            gains=gains,
            p=np.ascontiguousarray(p),
            dt=samples["dt"],
            out=out,
        )
        bad = self._run_c(one) if self.compiled else self._run_vm(one)
        return Run(**out, end=one.x, end_sensitivity=one.s, failed_at=None if bad == 0 else bad - 1)

    def _scratch(self, nk: int = 0) -> tuple[Pointer, Pointer, Pointer, Pointer, FloatArray]:
        a, r, i, w = self._work
        sizes = self.nx, self.nd, self.ne, self.ny, nk
        length = int(self._c.gb_buffer(*sizes, *self._tapes))
        return (
            (ctypes.c_void_p * a)(),
            (ctypes.c_void_p * r)(),
            (ctypes.c_longlong * i)(),
            (ctypes.c_double * w)(),
            np.empty(length),
        )

    @property
    def _tapes(self) -> tuple[Pointer, Pointer]:
        return ctypes.byref(self._slope.carrier), ctypes.byref(self._turn.carrier)

    def _run_c(self, one: _Pass) -> int:
        ns, gains, out = one.ns, one.gains, one.out
        slopes = [np.ascontiguousarray(v) for v in gains.derivative or ()] if ns else []
        moving = gains.moved_columns()
        nk = len(slopes[0]) if slopes else 0
        arg, res, iw, w, buffer = self._scratch(nk)
        gain = np.ascontiguousarray(gains.gain)
        zero = np.ascontiguousarray(gains.zero, dtype=np.int32)
        pointers = (ctypes.c_void_p * len(slopes))(*(v.ctypes.data for v in slopes)) if nk else None
        return int(
            self._c.gb_run(
                one.n,
                self.nx,
                self.nd,
                self.ne,
                self.ny,
                self.nu,
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
                _ptr(self._place),
                arg,
                res,
                iw,
                w,
                _ptr(buffer),
            )
        )

    def _run_vm(self, one: _Pass) -> int:
        x, s, u, mask, gains = one.x, one.s, one.u, one.mask, one.gains
        width = self.past + 1 + self.future
        na = len(self.active)
        for t in range(one.n):
            at = (x, u[t : t + width].T, one.y[t], one.p, one.dt)
            xf, e, yh = self.value(*at)
            e = np.asarray(e.full()).ravel() * (mask[t] != 0)
            for key, value in (
                ("states", x),
                ("innovations", e),
                ("outputs", np.asarray(yh.full()).ravel()),
            ):
                if (kept := one.out[key]) is not None:
                    kept[t] = value
            if s is not None:
                if (kept := one.out["state_sensitivity"]) is not None:
                    kept[t] = s
                a, b, ex, ep = self.slope(*at)
                de = ex.full() @ s
                de[:, :na] += ep.full()[:, self.columns]
                de *= (mask[t] != 0)[:, None]
                if (kept := one.out["sensitivity"]) is not None:
                    kept[t] = de
                moved = a.full() @ s
                moved[:, :na] += b.full()[:, self.columns]
            g = int(one.pattern[t])
            if gains.zero[g]:
                x[:] = np.asarray(xf.full()).ravel()
                if s is not None:
                    s[:] = moved
            else:
                xn, j1, j2 = self.inject(xf, gains.gain[g] @ e)
                x[:] = np.asarray(xn.full()).ravel()
                if s is not None:
                    push = gains.gain[g] @ de
                    if gains.derivative is not None:
                        slope = gains.derivative[g]
                        push[:, gains.moved_columns()] += (slope @ e).T
                    s[:] = j1.full() @ moved + j2.full() @ push
            if not np.isfinite(x).all():
                return 1 + t
        return 0

    def windows(
        self,
        *,
        starts: FloatArray,
        rows: Whole,
        lengths: Whole,
        tails: Whole,
        p: FloatArray,
        s0: FloatArray | None = None,
        steps: Whole | None = None,
        **samples: Unpack[Samples],
    ) -> Windows:
        """Open-loop runs of `lengths` (m,) samples from the states `starts` (m, n_x) at the
        record's `rows` (m,). inputs, outputs, mask, dt: see `Samples`.

        The innovations of the last `tails` (m,) samples of each window are kept, in order; of these
        with `steps` those that are so many samples behind the first. With `s0` (m, n_d, n_s) the
        sensitivities run along as in `run`.
        """
        outputs, ns = samples["outputs"], 0 if s0 is None else s0.shape[2]
        first, length, tail = (
            np.ascontiguousarray(v, dtype=np.int32) for v in (rows, lengths, tails)
        )
        asked = None if steps is None else np.zeros(length.max(initial=0), dtype=np.int32)
        kept = int(tail.sum())
        if asked is not None:
            asked[steps] = 1
            before = np.concatenate([[0], np.cumsum(asked)])
            kept = int((before[length] - before[length - tail]).sum())
        runs = _OpenRuns(
            first=first,
            length=length,
            tail=tail,
            asked=asked,
            x=np.array(starts, dtype=np.float64),
            s=None if s0 is None else np.array(s0, dtype=np.float64, order="C"),
            u=np.ascontiguousarray(samples["inputs"]),
            y=np.ascontiguousarray(np.where(np.isfinite(outputs), outputs, 0.0)),
            mask=np.ascontiguousarray(samples["mask"], dtype=np.float64),
            p=np.ascontiguousarray(p, dtype=np.float64),
            dt=samples["dt"],
            e=np.zeros((kept, self.ne)),
            de=None if s0 is None else np.zeros((kept, self.ne, ns)),
        )
        bad = self._windows_c(runs) if self.compiled else self._windows_vm(runs)
        return Windows(
            innovations=runs.e,
            sensitivity=runs.de,
            ends=runs.x,
            end_sensitivity=runs.s,
            failed_in=None if bad == 0 else bad - 1,
        )

    def _windows_c(self, runs: _OpenRuns) -> int:
        ns = 0 if runs.s is None else runs.s.shape[2]
        arg, res, iw, w, buffer = self._scratch()
        return int(
            self._c.gb_windows(
                len(runs.first),
                _ptr(runs.first),
                _ptr(runs.length),
                _ptr(runs.tail),
                _ptr(runs.asked),
                self.nx,
                self.nd,
                self.ne,
                self.ny,
                self.nu,
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
                _ptr(self._place),
                arg,
                res,
                iw,
                w,
                _ptr(buffer),
            )
        )

    def _windows_vm(self, runs: _OpenRuns) -> int:
        pattern, one = np.zeros(max(runs.length), dtype=np.int32), np.ones(1, dtype=np.int32)
        none = GainTable(gain=np.zeros((1, self.nd, self.ne)), zero=one)
        width, at = self.past + self.future, 0
        for i, (k, n, keep) in enumerate(zip(runs.first, runs.length, runs.tail, strict=True)):
            run = self.run(
                x0=runs.x[i],
                inputs=runs.u[k : k + n + width],
                outputs=runs.y[k : k + n],
                mask=runs.mask[k : k + n],
                pattern=pattern[:n],
                gains=none,
                p=runs.p,
                dt=runs.dt,
                s0=None if runs.s is None else runs.s[i],
                want=frozenset({"innovations", "sensitivity"}),
            )
            if run.failed_at is not None:
                return 1 + i
            runs.x[i] = run.end
            assert run.innovations is not None
            kept = np.arange(n - keep, n)
            if runs.asked is not None:
                kept = kept[runs.asked[kept] != 0]
            into = slice(at, at + kept.size)
            runs.e[into] = run.innovations[kept]
            if runs.s is not None and runs.de is not None and run.sensitivity is not None:
                runs.s[i] = run.end_sensitivity
                runs.de[into] = run.sensitivity[kept]
            at = into.stop
        return 0

    def rollout(
        self,
        *,
        starts: FloatArray,
        rows: npt.NDArray[np.int_],
        horizon: int,
        inputs: FloatArray,
        p: FloatArray,
        dt: float,
        want_states: bool = False,
    ) -> tuple[FloatArray, FloatArray | None]:
        """Open-loop outputs (m, horizon, n_y) at rows k, k+1, ... from the states `starts` (m, n_x)
        at the rows k."""
        m = len(rows)
        y = np.zeros((m, horizon, self.ny))
        states = np.zeros((m, horizon, self.nx)) if want_states else None
        starts = np.ascontiguousarray(starts, dtype=np.float64)
        u, p = np.ascontiguousarray(inputs), np.ascontiguousarray(p, dtype=np.float64)
        if self.compiled:
            arg, res, iw, w, buffer = self._scratch()
            k0 = np.ascontiguousarray(rows, dtype=np.int32)
            self._c.gb_rollout(
                m,
                horizon,
                self.nx,
                self.ny,
                self.nu,
                _ptr(starts),
                _ptr(k0),
                _ptr(u),
                _ptr(p),
                ctypes.c_double(dt),
                _ptr(y),
                _ptr(states),
                arg,
                res,
                iw,
                w,
                _ptr(buffer),
            )
            return y, states
        width = self.past + 1 + self.future
        step = self.pred.map(m)
        x = starts.T
        for h in range(horizon):
            windows = np.concatenate([u[k + h : k + h + width].T for k in rows], axis=1)
            after, yh = step(x, windows, np.repeat(p[:, None], m, 1), np.full((1, m), dt))
            y[:, h] = yh.full().T
            if states is not None:
                states[:, h] = np.asarray(x).T
            x = after.full()
        return y, states


def _ptr(array: npt.NDArray[np.generic] | None) -> Pointer:
    return None if array is None else array.ctypes.data_as(ctypes.c_void_p)


@functools.lru_cache(maxsize=64)
def _shelf(dynamics: Dynamics, use_compiler: bool) -> dict[tuple[tuple[str, ...], bool], Engine]:
    """Engines of one model that this process has built, by active parameters and whether they have
    sensitivities."""
    return {}


def engine_for(
    dynamics: Dynamics,
    active: tuple[str, ...],
    *,
    use_compiler: bool = True,
    sensitive: bool = True,
) -> Engine:
    """The engine of a model and a set of active parameters, built once per process.

    One that is there already with more parameters serves: those that were not asked for are not
    carried.
    """
    active = tuple(active)
    try:
        shelf = _shelf(dynamics, use_compiler)  # type: ignore[arg-type]
    except TypeError:  # a model that cannot be hashed
        shelf = {}
    key = active, sensitive
    if key not in shelf:
        larger = [
            e for (own, has), e in shelf.items() if set(active) <= set(own) and has >= sensitive
        ]
        shelf[key] = (
            min(larger, key=lambda e: len(e.active)).select(active)
            if larger
            else Engine(dynamics, active, use_compiler=use_compiler, sensitive=sensitive)
        )
    return shelf[key]


def _built_again(
    dynamics: Dynamics,
    built: tuple[str, ...],
    active: tuple[str, ...],
    use_compiler: bool,
    sensitive: bool,
) -> Engine:
    whole = engine_for(dynamics, built, use_compiler=use_compiler, sensitive=sensitive)
    return whole.select(active)


def unfelt_place(dynamics: Dynamics) -> frozenset[str]:
    """Coordinates of the position, of "x", "y" and "z", that no other state's step depends on: what
    was identified in one corner of a room holds in the other."""
    names = dynamics.states.names
    with CASADI:
        s = symbols(dynamics)
        quiet = ca.DM.zeros(len(dynamics.noises))
        after = dynamics.step(0, s["x"], s["U"], s["p"], quiet, s["dt"])
        rest = after[[i for i, n in enumerate(names) if not n.startswith("position.")]]
        return frozenset(
            n.removeprefix("position.")
            for i, n in enumerate(names)
            if n in ("position.x", "position.y", "position.z")
            and not ca.depends_on(rest, s["x"][i])
        )
