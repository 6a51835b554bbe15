"""Sampled: a Dynamics as a controller sees it, one sample long, its command held, everything that
it needs in its state.

    X+ = step(X, u, p, w),   y = output(X, u, p, w),   X = (x, history)

A delay looks at earlier commands. They become states: `history.<input>.<k>` is the command of k
samples ago, as many as the model needs at its baked delay. Inputs that a controller does not choose
(the battery voltage) become run-time parameters. The learned part of a hybrid is left out here: it
enters through the process-noise channels w. All expressions are SX.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import casadi as ca
import numpy as np
import numpy.typing as npt

from greybox.errors import ModelError, UnknownNameError
from greybox.estimation.engine import chart_jacobians
from greybox.estimation.reference_point import ReferenceStep, reference_step
from greybox.model.dynamics import Dynamics, StateSpaceModel
from greybox.model.identified import IdentifiedModel
from greybox.model.layer import innermost, with_core
from greybox.model.linear import LinearModel
from greybox.model.model import PhysicsModel
from greybox.residual.features import features
from greybox.symbolic import Expr, FloatArray, Layout, Signal

AS_WELL = 0.02
"""By how much a mode may be left with another share after a longer sample than after as long in the
samples that it was identified at."""
MINUTES = 0.01
"""Rate [1/s] below which nothing decays in a flight."""
EXOGENOUS = ("vbat",)
"""Inputs of a multirotor that nobody commands."""


def is_discrete(dynamics: Dynamics) -> bool:
    """Whether the model is a map from sample to sample, without a derivative."""
    core = innermost(dynamics)
    return isinstance(core, LinearModel) or (isinstance(core, StateSpaceModel) and core.discrete)


def at_sample_time(model: IdentifiedModel | LinearModel, dynamics: Dynamics, dt: float) -> Dynamics:
    """The same model for another sample time: its command window holds as many samples as its delay
    then needs. What decays goes on decaying: a sample takes the fewest Runge-Kutta steps that leave
    of every mode about the model's reference what the steps leave that it was identified with
    (`AS_WELL`), none of them shorter than these."""
    core = innermost(dynamics)
    if not isinstance(model, IdentifiedModel):
        return dynamics
    if isinstance(core, PhysicsModel):
        # Rotors are stepped exactly.
        body = [i for i, n in enumerate(core.states.names) if not n.startswith("rotor")]
        parts = _steps(_decaying(core, model, body), model.sample_time, dt)
        return with_core(dynamics, replace(core, sample_time=dt, parts=parts))
    if isinstance(core, StateSpaceModel) and not core.discrete:
        modes = _decaying(core, model, list(range(len(core.states))))
        parts = _steps(modes, model.sample_time / core.substeps, dt)
        return with_core(dynamics, replace(core, substeps=parts))
    return dynamics


def _steps(modes: npt.NDArray[np.complex128], own: float, dt: float) -> int:
    """How many steps a sample of `dt` [s] takes, where steps of `own` [s] were identified with."""
    most = max(1, math.ceil(dt / own - 1e-9))
    left = _runge_kutta(modes * own) ** (dt / own)

    def as_well(n: int) -> bool:
        return bool((np.abs(_runge_kutta(modes * dt / n) ** n - left) < AS_WELL).all())

    return next((n for n in range(1, most) if as_well(n)), most)


def _decaying(
    core: PhysicsModel | StateSpaceModel, model: IdentifiedModel, rows: list[int]
) -> npt.NDArray[np.complex128]:
    """Eigenvalues [1/s] of these states about the model's reference that decay within minutes."""
    x, u = ca.SX.sym("x", len(core.states)), model.reference_inputs[: len(core.inputs)]
    p = ca.DM([model.values[d.name] for d in core.parameters])
    slope = ca.Function("slope", [x], [ca.jacobian(core.f(0, x, ca.DM(u), p), x)])
    found = np.linalg.eigvals(
        slope(model.reference_state[: len(core.states)]).full()[np.ix_(rows, rows)]
    )
    return np.asarray(found[found.real < -MINUTES])


def _runge_kutta(z: npt.NDArray[np.complex128]) -> npt.NDArray[np.complex128]:
    """What a Runge-Kutta step of 4th order multiplies a mode by, z = eigenvalue times step."""
    return 1 + z * (1 + z / 2 * (1 + z / 3 * (1 + z / 4)))


@dataclass(frozen=True, kw_only=True, eq=False)
class Sampled:
    """`dynamics` (without a learned part) at sample time `dt` [s] with `values`; `runtime`
    parameters stay symbolic.

    `sensitive` are the parameters whose sensitivities must come out right too (they may need one
    command more). Raises `UnknownNameError` for a parameter that the model does not have.
    """

    dynamics: Dynamics
    dt: float
    values: Mapping[str, float]
    runtime: tuple[str, ...] = ()
    sensitive: tuple[str, ...] = ()
    looks_back: Mapping[str, int] = field(default_factory=dict)
    """How many samples back a learned part looks at an input."""
    measured: bool = True
    """Whether outputs must come out right; else the history has what the step feels alone."""

    def __post_init__(self) -> None:
        known = [d.name for d in self.dynamics.parameters]
        for name in (*self.runtime, *self.sensitive):
            if name not in known:
                raise UnknownNameError("parameter", name, known)

    @cached_property
    def _maps(self) -> ReferenceStep:
        """Step and outputs of the model, which are written once."""
        return reference_step(self.dynamics, ())

    @cached_property
    def _chart(self) -> ca.Function:
        """`chart_jacobians` of the model, written once."""
        x, z = (ca.SX.sym(n, len(self.dynamics.states)) for n in "xz")
        return ca.Function("chart", [x, z], chart_jacobians(self.dynamics, x, z))

    # ------------------------------------------------------------------------------------- layouts

    @cached_property
    def exogenous(self) -> tuple[str, ...]:
        """Input columns that are run-time parameters here."""
        if isinstance(self.dynamics, LinearModel):
            return ()
        return tuple(n for n in self.dynamics.inputs.names if n in EXOGENOUS)

    @cached_property
    def inputs(self) -> Layout:
        """Commands u (n_u)."""
        return Layout([s for s in self.dynamics.inputs if s.name not in self.exogenous])

    @cached_property
    def parameters(self) -> Layout:
        """Run-time parameters p (n_p): exogenous inputs, then `runtime` in the order given."""
        units = {d.name: d for d in self.dynamics.parameters}
        signals = [s for s in self.dynamics.inputs if s.name in self.exogenous]
        signals += [
            Signal(name=n, unit=units[n].unit, meaning=units[n].meaning) for n in self.runtime
        ]
        return Layout(signals)

    @cached_property
    def history(self) -> tuple[tuple[int, int], ...]:
        """(input, lag in samples) of every history state: all first lags, then all second ones."""
        past = self.dynamics.window[0]
        if past == 0:
            return ()
        count = len(self.dynamics.inputs)
        x, window, p, w = self._plain_symbols()
        theta = ca.SX.sym("theta", len(self.sensitive))
        full = self._vector(p, theta)
        given = (x, window, full, w, self.dt)
        felt = self._maps.stepped(*given)
        if self.measured:
            felt = ca.vertcat(felt, self._maps.predicted(*given))
        everything = ca.vertcat(
            felt, ca.vec(ca.jacobian(felt, theta)), ca.vec(ca.jacobian(felt, p))
        )
        baked = ca.substitute(everything, theta, self._baked(p, self.sensitive))
        needed = _felt(baked, [x, window, p, w], 1).reshape(-1, count)  # column by column
        out: list[tuple[int, int]] = []
        for i, name in enumerate(self.dynamics.inputs.names):
            needed[past - self.looks_back.get(name, 0), i] = True
        longest = [
            max(lag for lag in range(past + 1) if needed[past - lag, i] or not lag)
            for i in range(count)
        ]
        for lag in range(1, max(longest, default=0) + 1):
            out += [(i, lag) for i in range(count) if longest[i] >= lag]
        if any(self.dynamics.inputs.names[i] in self.exogenous for i, _ in out):
            raise ModelError(
                "an earlier battery voltage cannot be a state", fix="leave the delay of vbat out"
            )
        return tuple(out)

    def _history_signals(self, prefix: str) -> list[Signal]:
        inputs = self.dynamics.inputs.signals
        return [
            Signal(
                name=f"{prefix}history.{inputs[i].name}.{lag}",
                unit=inputs[i].unit,
                meaning=f"command {lag} samples ago",
            )
            for i, lag in self.history
        ]

    @cached_property
    def states(self) -> Layout:
        """X (n_x): the model's own states, then the history."""
        return self.dynamics.states + Layout(self._history_signals(""))

    @cached_property
    def error_states(self) -> Layout:
        """Error state (n_d): the model's own, then the history's."""
        return self.dynamics.error_states + Layout(self._history_signals("d_"))

    # ------------------------------------------------------------------------------------- vectors

    def symbols(self) -> tuple[Expr, Expr, Expr, Expr]:
        """SX symbols X, u, p, w."""
        return (
            ca.SX.sym("x", len(self.states)),
            ca.SX.sym("u", len(self.inputs)),
            ca.SX.sym("p", len(self.parameters)),
            ca.SX.sym("w", len(self.dynamics.noises)),
        )

    def _plain_symbols(self) -> tuple[Expr, Expr, Expr, Expr]:
        past, future = self.dynamics.window
        return (
            ca.SX.sym("x", len(self.dynamics.states)),
            ca.SX.sym("U", len(self.dynamics.inputs), past + 1 + future),
            ca.SX.sym("p", len(self.parameters)),
            ca.SX.sym("w", len(self.dynamics.noises)),
        )

    def _baked(self, p: Expr, names: Sequence[str]) -> Expr:
        """The named model parameters: entries of p where they are run-time ones, numbers where
        not."""
        layout = self.parameters
        return ca.vertcat(
            ca.SX(0, 1), *(p[layout[n]] if n in layout else self.values[n] for n in names)
        )

    def _vector(self, p: Expr, theta: Expr | None = None) -> Expr:
        """The model's own parameter vector; `theta` stands for the `sensitive` ones."""
        names = [d.name for d in self.dynamics.parameters]
        full = ca.SX(self._baked(p, names))
        if theta is not None:
            for k, name in enumerate(self.sensitive):
                full[names.index(name)] = theta[k]
        return full

    def current(self, u: Expr, p: Expr) -> Expr:
        """The model's own input column from commands and exogenous inputs."""
        layout = self.parameters
        rows = [
            p[layout[n]] if n in self.exogenous else u[self.inputs[n]]
            for n in self.dynamics.inputs.names
        ]
        return ca.vertcat(*rows)

    def window(self, x: Expr, u: Expr, p: Expr) -> Expr:
        """The model's command window; the present command stands where no earlier one is looked
        at."""
        past, future = self.dynamics.window
        now = self.current(u, p)
        at = {pair: len(self.dynamics.states) + k for k, pair in enumerate(self.history)}
        columns = []
        for column in range(past + 1 + future):
            lag = past - column
            columns.append(
                ca.vertcat(
                    *(x[at[i, lag]] if (i, lag) in at else now[i] for i in range(now.numel()))
                )
            )
        return ca.horzcat(*columns)

    def core(self, x: Expr) -> Expr:
        """The model's own states out of X."""
        return x[: len(self.dynamics.states)]

    # ------------------------------------------------------------------------------------ the maps

    def step(self, x: Expr, u: Expr, p: Expr, w: Expr, theta: Expr | None = None) -> Expr:
        """X one sample later."""
        window, full = self.window(x, u, p), self._vector(p, theta)
        after = self._maps.stepped(self.core(x), window, full, w, self.dt)
        now = self.current(u, p)
        n = len(self.dynamics.states)
        at = {pair: n + k for k, pair in enumerate(self.history)}
        return ca.vertcat(
            after, *(now[i] if lag == 1 else x[at[i, lag - 1]] for i, lag in self.history)
        )

    def output(self, x: Expr, u: Expr, p: Expr, w: Expr, theta: Expr | None = None) -> Expr:
        """Outputs y at the sample."""
        window, full = self.window(x, u, p), self._vector(p, theta)
        return self._maps.predicted(self.core(x), window, full, w, self.dt)

    def derivative(self, x: Expr, u: Expr, p: Expr, w: Expr) -> Expr:
        """dx/dt of the model's own states, without the delay."""
        return self.dynamics.f(0, self.core(x), self.current(u, p), self._vector(p), w)

    def innovation(self, y: Expr, y_hat: Expr, x: Expr) -> Expr:
        """Innovation (n_e) of measured outputs against predicted ones."""
        return self.dynamics.innovation(y, y_hat, self.core(x))

    def boxplus(self, x: Expr, d: Expr) -> Expr:
        """X moved by an error state (n_d)."""
        # Of a scalar CasADi's [1:] is a row, and a sum of rows fills up with a zero: rows are asked
        # for by name.
        n, m = len(self.dynamics.states), len(self.dynamics.error_states)
        return ca.vertcat(self.dynamics.boxplus(x[:n], d[:m]), x[n:, :] + d[m:, :])

    def boxminus(self, x2: Expr, x1: Expr) -> Expr:
        """The error state that carries x1 into x2."""
        n = len(self.dynamics.states)
        return ca.vertcat(self.dynamics.boxminus(x2[:n], x1[:n]), x2[n:, :] - x1[n:, :])

    def chart(self, x: Expr, z: Expr) -> tuple[Expr, Expr]:
        """(d boxplus(x, d)/dd at d = 0 (n_x, n_d), d boxminus(z', z)/dz' at z' = z (n_d, n_x))."""
        n, h = len(self.dynamics.states), ca.SX.eye(len(self.history))
        into, out = self._chart(x[:n], z[:n])
        return ca.diagcat(into, h), ca.diagcat(out, h)

    def features(self, names: Sequence[str], x: Expr, u: Expr, p: Expr) -> Expr:
        """Inputs of a learned part, by name (greybox/residual/features.py)."""
        return features(self.dynamics, names, self.core(x), self.window(x, u, p))

    # ----------------------------------------------------------------------------------- reference

    def extended(
        self, state: FloatArray, inputs: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(X, u, p) of a state and an input column of the model that has been the same for long."""
        column = dict(
            zip(self.dynamics.inputs.names, np.asarray(inputs, dtype=float).tolist(), strict=True)
        )
        names = self.dynamics.inputs.names
        past = [column[names[i]] for i, _ in self.history]
        p = [column.get(n, self.values.get(n, np.nan)) for n in self.parameters.names]
        return (
            np.concatenate([state, past]),
            np.array([column[n] for n in self.inputs.names]),
            np.array(p),
        )


def _felt(value: Expr, symbols: Sequence[Expr], which: int) -> npt.NDArray[np.bool_]:
    """Per entry of symbols[which] whether `value` really depends on it: by structure, and by slope
    at random points.

    A delay of whole samples (or none) keeps a command in the expression with a factor that is
    exactly zero.
    """
    inner = ca.vec(symbols[which])
    by_structure = np.array(ca.which_depends(value, inner, 1, False), dtype=bool)
    slope = ca.Function("slope", list(symbols), [ca.sum1(ca.fabs(ca.jacobian(value, inner)))])
    rng = np.random.default_rng(0)
    total = np.zeros(inner.numel())
    for _ in range(20):
        point = [rng.uniform(0.05, 0.95, size=s.shape) for s in symbols]
        total = np.maximum(total, np.nan_to_num(slope(*point).full().ravel(), nan=np.inf))
    return by_structure & (total > 0)
