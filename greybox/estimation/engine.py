"""Engine: one step of a Dynamics with its exact sensitivities, compiled to C, and the recursions
over a record.

The step is linearised symbolically in the error state (SX, sparse). The step itself is generated as
C, its linearisation is a tape (`greybox.estimation.tape`); a recursion (`greybox.estimation.recursion`)
carries both, and the sensitivities S = d(error state)/d(parameters), over the samples of a record.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from importlib import resources
from typing import TypedDict, Unpack

import casadi as ca
import numpy as np
import numpy.typing as npt

from greybox.errors import FitError, ModelError, UnknownNameError
from greybox.estimation.build import DRIVER_FLAGS, MODEL_FLAGS, compiler, opened
from greybox.estimation.cache import say
from greybox.estimation.recursion import (
    Compiled,
    GainTable,
    IntArray,
    Interpreted,
    OpenRuns,
    Pass,
    Rollout,
    Sizes,
)
from greybox.estimation.reference_point import chart_jacobians, reference_step
from greybox.estimation.tape_cache import linears
from greybox.model.dynamics import Dynamics
from greybox.symbolic import CASADI, FloatArray, evaluate

Whole = npt.NDArray[np.int32 | np.int64]
"""Whole numbers of any size."""


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


class Samples(TypedDict):
    """The samples of one record, as keywords of `Engine.run` and `Engine.windows`: `inputs` padded
    by `padded_inputs`, outputs (n, n_y; NaN where missing), mask (n, n_e), dt [s]."""

    inputs: FloatArray
    outputs: FloatArray
    mask: FloatArray
    dt: float


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

    def demand_finite(self, what: str, rows: Whole | None = None) -> None:
        """Raise `FitError` where the numbers of `what` stopped being finite, at the sample where
        that window begins: of `rows` (m,), else one window a sample."""
        if self.failed_in is not None:
            at = self.failed_in if rows is None else rows[self.failed_in]
            raise FitError(f"{what} that begins at sample {at} is not finite")


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
            self.built, self.columns = active, np.arange(len(active))
            self._functions()
        made = self._compiled() if use_compiler and compiler() is not None else None
        self._recursion = self._interpreted() if made is None else made

    def __reduce__(self) -> tuple[object, ...]:
        """What is compiled stays in its process: another one builds it again, from the cache."""
        built = self.dynamics, self.built, self.active, self.use_compiler, self.sensitive
        return _built_again, built

    def command_windows(self, inputs: FloatArray, rows: npt.NDArray[np.int_]) -> FloatArray:
        """The commands that a step looks at, of samples `rows` (...) of padded `inputs`: (..., n_u
        k), one of the k commands after the other."""
        width = self.past + 1 + self.future
        return np.asarray(inputs[rows[..., None] + np.arange(width)].reshape(*rows.shape, -1))

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
        if isinstance(self._recursion, Compiled):
            place = np.full(len(self.built), -1, dtype=np.int32)
            place[some.columns] = np.arange(len(active))
            some._recursion = replace(self._recursion, place=place)
        else:
            some._recursion = replace(self._recursion, columns=some.columns)
        return some

    @property
    def compiled(self) -> bool:
        """Whether the step runs as compiled C."""
        return isinstance(self._recursion, Compiled)

    @property
    def _sizes(self) -> Sizes:
        return Sizes(
            states=self.nx,
            errors=self.nd,
            innovations=self.ne,
            outputs=self.ny,
            inputs=self.nu,
            window=self.past + 1 + self.future,
        )

    def _interpreted(self) -> Interpreted:
        return Interpreted(
            sizes=self._sizes,
            value=self.value,
            inject=self.inject,
            pred=self.pred,
            slope=lambda: self.slope,
            columns=self.columns,
        )

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

    def _compiled(self) -> Compiled | None:
        """The recursion in C; None where it cannot be compiled."""
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
            return None
        names = [d.name for d in self.dynamics.parameters]
        try:
            with CASADI:
                found = linears(
                    self._stepped,
                    f"{self.built} of {names}, sensitive: {self.sensitive}; {self.move.serialize()}",
                    {"slope": lambda: self.slope, "turn": lambda: self.turn},
                )
        except ModelError as error:
            say(f"{error}; CasADi's VM runs the same equations, slower")
            return None
        return Compiled(
            library=library, sizes=self._sizes, slope=found["slope"], turn=found["turn"]
        )

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
        one = Pass(
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
        bad = self._recursion.run(one)
        return Run(**out, end=one.x, end_sensitivity=one.s, failed_at=None if bad == 0 else bad - 1)

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
        runs = OpenRuns(
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
        bad = self._recursion.windows(runs)
        return Windows(
            innovations=runs.e,
            sensitivity=runs.de,
            ends=runs.x,
            end_sensitivity=runs.s,
            failed_in=None if bad == 0 else bad - 1,
        )

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
        self._recursion.rollout(
            Rollout(
                starts=np.ascontiguousarray(starts, dtype=np.float64),
                rows=np.ascontiguousarray(rows, dtype=np.int32),
                u=np.ascontiguousarray(inputs),
                p=np.ascontiguousarray(p, dtype=np.float64),
                dt=dt,
                y=y,
                states=states,
            )
        )
        return y, states


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
        at = reference_step(dynamics, ())
        after = ca.substitute(at.after, at.w, ca.DM.zeros(at.w.numel()))
        rest = after[[i for i, n in enumerate(names) if not n.startswith("position.")]]
        return frozenset(
            n.removeprefix("position.")
            for i, n in enumerate(names)
            if n in ("position.x", "position.y", "position.z") and not ca.depends_on(rest, at.x[i])
        )
