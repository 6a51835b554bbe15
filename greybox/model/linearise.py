"""Trim and linearise any `Dynamics`, and linear models whose matrices are functions of named
parameters.

A trim point is a state and a command at which the state does not change from sample to sample (up
to the drift that is allowed, e.g. a position under steady flight). There the sampled model x+ =
step(x, u), y = output(x, u) has the Jacobians A, B, C, D in the error state of the chart
(`boxplus`, `boxminus`), so that a quaternion counts three.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from greybox.errors import ModelError, UnknownNameError
from greybox.model.dynamics import Dynamics
from greybox.model.linear import LinearModel
from greybox.model.matrices import Matrices
from greybox.model.parameter import ParameterValues, nominal_values
from greybox.symbolic import BoolArray, Expr, FloatArray, Layout


@dataclass(frozen=True, kw_only=True)
class TrimPoint:
    """State x (n_x), command u (n_u), and the largest remaining change of the error state per
    sample, `residual`."""

    x: FloatArray
    u: FloatArray
    residual: float


def trim(
    model: Dynamics,
    dt: float,
    *,
    values: Mapping[str, float] | None = None,
    start: FloatArray | None = None,
    command: FloatArray | None = None,
    fixed_states: Sequence[str] = (),
    free_commands: Sequence[str] | None = None,
    ignore: Sequence[str] = (),
    tolerance: float = 1e-9,
    max_iterations: int = 100,
) -> TrimPoint:
    """Find x and u with boxminus(step(x, u), x) = 0, by damped Gauss-Newton of least change from
    the start.

    `fixed_states` are error states held at the start, `ignore` error states that may drift,
    `free_commands` the inputs that may move (default: all). Raises `UnknownNameError`, and
    `ModelError` where no trim point is found.
    """
    p = _vector(model, values)
    x = np.asarray(model.initial_state({})[0] if start is None else start, dtype=float)
    u = np.zeros(len(model.inputs)) if command is None else np.asarray(command, dtype=float)
    nd, nu = len(model.error_states), len(model.inputs)
    move_x = np.array([n not in fixed_states for n in model.error_states.names])
    for name in (*fixed_states, *ignore):
        model.error_states[name]
    chosen = model.inputs.names if free_commands is None else tuple(free_commands)
    for name in chosen:
        model.inputs[name]
    move = np.concatenate([move_x, [n in chosen for n in model.inputs.names]])
    rows = np.array([n not in ignore for n in model.error_states.names])
    function = _trim_function(model, dt, p)
    change, jacobian = _evaluated(function, x, u)
    damping = 0.0
    for _ in range(max_iterations):
        size = float(np.abs(change[rows]).max(initial=0.0))
        if size < tolerance:
            return TrimPoint(x=x, u=u, residual=size)
        if not move.any():
            break
        j = jacobian[np.ix_(rows, move)]
        left, s, right = np.linalg.svd(j, full_matrices=False)
        weight = np.where(s > 1e-10 * max(s[0], 1e-300), s / (s**2 + damping * s[0] ** 2), 0.0)
        step = np.zeros(nd + nu)
        step[move] = -right.T @ (weight * (left.T @ change[rows]))
        better = _nearer(function, x, u, step, rows, size)
        if better is not None:
            x, u, change, jacobian = better
            damping = damping / 10 if damping > 1e-12 else 0.0
            continue
        if damping > 1.0:
            break
        damping = max(damping * 10, 1e-6)
    raise ModelError(
        f"{model.name}: no trim point found (the state still changes by "
        f"{np.abs(change[rows]).max():.3g} per sample)",
        fix="start nearer, free more states or commands, or let drifting states be ignored",
    )


def _nearer(
    function: Mapping[str, ca.Function],
    x: FloatArray,
    u: FloatArray,
    step: FloatArray,
    rows: BoolArray,
    size: float,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray] | None:
    """(x, u, change, Jacobian) after the step, or the half of it and so on, whose largest change
    in `rows` is less than `size`; None for none."""
    scale, nd = 1.0, len(step) - len(u)
    for _ in range(30):
        there = np.asarray(function["move"](x, scale * step[:nd])).ravel()
        u_there = u + scale * step[nd:]
        change, jacobian = _evaluated(function, there, u_there)
        if np.isfinite(change).all() and np.abs(change[rows]).max() < size:
            return there, u_there, change, jacobian
        scale *= 0.5
    return None


def linearise(
    model: Dynamics,
    point: TrimPoint,
    dt: float,
    *,
    values: Mapping[str, float] | None = None,
    outputs: Sequence[str] | None = None,
    states: Sequence[str] | None = None,
    noise: FloatArray | None = None,
) -> LinearModel:
    """The sampled linear model around a trim point, exact Jacobians; K = 0 and Lambda = identity
    unless `noise` is given.

    Outputs are the innovation components of the model: a measured quaternion gives three small
    angles about the trim attitude. `outputs` and `states` select by name; states that are left out
    must not act on those that stay (`ModelError`). A command delay of the model is not part of the
    matrices: linearise the model without it, and use `delays`.
    """
    p = _vector(model, values)
    a, b, c, d = (np.asarray(m) for m in _jacobians(model, dt)(point.x, point.u, p))
    names = model.error_states.names
    if states is not None:
        keep = [model.error_states[n] for n in states]
        gone = [i for i in range(len(names)) if i not in keep]
        acting = np.abs(a[np.ix_(keep, gone)]).max(initial=0.0)
        if acting > 1e-9:
            raise ModelError(
                f"states left out act on those that stay (entry {acting:.3g})",
                fix="keep them, or trim elsewhere",
            )
        a, b, c = a[np.ix_(keep, keep)], b[keep], c[:, keep]
    layout = model.innovations
    y = np.asarray(_output_function(model, dt)(point.x, point.u, p)).ravel()
    plain = [columns == (name,) for name, columns in zip(layout.names, model.innovation_columns)]
    y0 = np.array([y[model.outputs[n]] if same else 0.0 for n, same in zip(layout.names, plain)])
    if outputs is not None:
        rows = [layout[n] for n in outputs]
        c, d, y0 = c[rows], d[rows], y0[rows]
        layout = Layout([layout.signals[i] for i in rows])
    p_out = len(layout)
    return LinearModel(
        name=f"{model.name} at trim",
        matrices=Matrices(a, b, c, d, np.zeros((len(a), p_out))),
        noise=np.eye(p_out) if noise is None else noise,
        dt=dt,
        inputs=model.inputs,
        outputs=layout,
        input_offset=point.u,
        output_offset=y0,
    )


@dataclass(frozen=True, kw_only=True)
class StructuredLinear:
    """A(theta), B(theta), C(theta), D(theta) as CasADi expressions of named parameters; continuous
    or sampled.

    `theta` (n_theta,) is the symbol, `names` its components. A continuous model is sampled exactly,
    with the input held over `dt` [s]. `function` of the matrices and of their derivatives is built
    once.
    """

    name: str
    names: tuple[str, ...]
    theta: Expr
    a: Expr
    b: Expr
    c: Expr
    d: Expr
    dt: float
    continuous: bool = True
    inputs: Layout = field(default_factory=lambda: Layout([]))
    outputs: Layout = field(default_factory=lambda: Layout([]))

    def __post_init__(self) -> None:
        if self.theta.numel() != len(self.names):
            raise ModelError(
                f"{self.name}: {self.theta.numel()} symbols for {len(self.names)} names"
            )
        parts = [ca.densify(ca.SX(m)) for m in (self.a, self.b, self.c, self.d)]
        values = ca.Function("matrices", [self.theta], parts)
        slopes = ca.Function(
            "slopes", [self.theta], [ca.densify(ca.jacobian(ca.vec(m), self.theta)) for m in parts]
        )
        object.__setattr__(self, "_values", values)
        object.__setattr__(self, "_slopes", slopes)

    def matrices(self, theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Sampled A (n, n), B (n, m), C (p, n), D (p, m) at theta."""
        a, b, c, d = (np.asarray(m, dtype=float) for m in self._values(theta))  # type: ignore[attr-defined]
        if self.continuous:
            a, b = _sampled(a, b, self.dt)
        return a, b, c, d

    def derivatives(
        self, theta: FloatArray
    ) -> list[tuple[FloatArray, FloatArray, FloatArray, FloatArray]]:
        """Derivatives of the sampled matrices with respect to each component of theta."""
        from scipy.linalg import expm_frechet

        values = [np.asarray(m, dtype=float) for m in self._values(theta)]  # type: ignore[attr-defined]
        slopes = [np.asarray(m, dtype=float) for m in self._slopes(theta)]  # type: ignore[attr-defined]
        n, m = values[1].shape
        out = []
        for i in range(len(self.names)):
            da, db, dc, dd = (s[:, i].reshape(v.shape, order="F") for s, v in zip(slopes, values))
            if self.continuous:
                block, change = np.zeros((n + m, n + m)), np.zeros((n + m, n + m))
                block[:n, :n], block[:n, n:] = values[0] * self.dt, values[1] * self.dt
                change[:n, :n], change[:n, n:] = da * self.dt, db * self.dt
                moved = expm_frechet(block, change, compute_expm=False)
                da, db = moved[:n, :n], moved[:n, n:]
            out.append((da, db, dc, dd))
        return out


def structured_from(
    model: Dynamics,
    point: TrimPoint,
    dt: float,
    names: Sequence[str],
    *,
    values: Mapping[str, float] | None = None,
) -> StructuredLinear:
    """The linearised model as a function of some of the physical parameters, at a fixed trim point.

    The trim command may itself depend on the parameters; it is held here, which is exact for
    parameters that do not move the trim and a good approximation near it (the operating point of
    the data is estimated as an offset anyway). Raises `UnknownNameError`.
    """
    known = {p.name for p in model.parameters}
    for n in names:
        if n not in known:
            raise UnknownNameError("parameter", n, known)
    base = _vector(model, values)
    theta = ca.SX.sym("theta", len(names))
    position = [q.name for q in model.parameters]
    p = ca.SX(ca.DM(base))
    for i, n in enumerate(names):
        p[position.index(n)] = theta[i]
    a, b, c, d = _jacobians(model, dt)(ca.DM(point.x), ca.DM(point.u), p)
    return StructuredLinear(
        name=f"{model.name} linearised",
        names=tuple(names),
        theta=theta,
        a=a,
        b=b,
        c=c,
        d=d,
        dt=dt,
        continuous=False,
        inputs=model.inputs,
        outputs=model.innovations,
    )


def _vector(model: Dynamics, values: Mapping[str, float] | None) -> FloatArray:
    chosen = nominal_values(model.parameters).replace(dict(values or {}))
    assert isinstance(chosen, ParameterValues)
    return np.array([chosen[p.name] for p in model.parameters])


def _symbols(model: Dynamics) -> tuple[Expr, Expr, Expr, Expr]:
    x, u = ca.SX.sym("x", len(model.states)), ca.SX.sym("u", len(model.inputs))
    p = ca.SX.sym("p", len(model.parameters))
    past, future = model.window
    return x, u, p, ca.repmat(u, 1, past + 1 + future)


def _jacobians(model: Dynamics, dt: float) -> ca.Function:
    x, u, p, window = _symbols(model)
    delta, v = ca.SX.sym("delta", len(model.error_states)), ca.SX.sym("v", len(model.inputs))
    driven = ca.repmat(v, 1, window.shape[1])
    after, e = deviations(model, dt, (x, window), (model.boxplus(x, delta), window), p)
    by_u, e_u = deviations(model, dt, (x, window), (x, driven), p)
    zero = ca.SX.zeros(delta.shape)
    a, c = (ca.substitute(ca.jacobian(q, delta), delta, zero) for q in (after, e))
    b, d = (ca.substitute(ca.jacobian(q, v), v, u) for q in (by_u, e_u))
    return ca.Function("linear", [x, u, p], [ca.densify(m) for m in (a, b, c, d)])


def deviations(
    model: Dynamics, dt: float, rest: tuple[Expr, Expr], moved: tuple[Expr, Expr], p: Expr
) -> tuple[Expr, Expr]:
    """(error state (n_d) after one sample of `dt` seconds, innovation (n_e)) of `moved`, a state
    and its command window, against `rest`, without noise."""
    w = ca.SX.zeros(len(model.noises))
    (x0, u0), (x, u) = rest, moved
    after = model.boxminus(model.step(0.0, x, u, p, w, dt), model.step(0.0, x0, u0, p, w, dt))
    seen = model.innovation(
        model.output(0.0, x, u, p, w, dt), model.output(0.0, x0, u0, p, w, dt), x0
    )
    return after, seen


def _output_function(model: Dynamics, dt: float) -> ca.Function:
    x, u, p, window = _symbols(model)
    return ca.Function(
        "y", [x, u, p], [model.output(0.0, x, window, p, ca.SX.zeros(len(model.noises)), dt)]
    )


def _trim_function(model: Dynamics, dt: float, p: FloatArray) -> dict[str, ca.Function]:
    x, u, _, window = _symbols(model)
    delta = ca.SX.sym("delta", len(model.error_states))
    w, values = ca.SX.zeros(len(model.noises)), ca.DM(p)
    moved = model.boxplus(x, delta)
    change = model.boxminus(model.step(0.0, moved, window, values, w, dt), moved)
    jacobian = ca.jacobian(change, ca.vertcat(delta, u))
    zero = ca.SX.zeros(delta.shape)
    outputs = [ca.densify(ca.substitute(q, delta, zero)) for q in (change, jacobian)]
    return {
        "change": ca.Function("change", [x, u], outputs),
        "move": ca.Function("move", [x, delta], [moved]),
    }


def _evaluated(
    function: Mapping[str, ca.Function], x: FloatArray, u: FloatArray
) -> tuple[FloatArray, FloatArray]:
    change, jacobian = function["change"](x, u)
    return np.asarray(change, dtype=float).ravel(), np.asarray(jacobian, dtype=float)


def _sampled(a: FloatArray, b: FloatArray, dt: float) -> tuple[FloatArray, FloatArray]:
    """Exact sampling with the input held (van Loan 1978)."""
    from scipy.linalg import expm

    n, m = b.shape
    block = np.zeros((n + m, n + m))
    block[:n, :n], block[:n, n:] = a * dt, b * dt
    moved = expm(block)
    return moved[:n, :n], moved[:n, n:]
