"""Stationary Kalman gain of a linearised Dynamics, and its exact derivative with respect to all parameters.

Linearisation at a reference point, with process noise w ~ (0, Q) that enters state and output alike:

    d+ = A d + G w,   e = C d + D w + v,   v ~ (0, R)
    P = A P A' + G Q G' - K S K',   S = C P C' + D Q D' + R,   K = (A P C' + G Q D') S^-1

(Anderson and Moore 1979, Optimal Filtering, ch. 4 and sec. 5.4 for correlated noise.) The Riccati equation is solved by
structure-preserving doubling (Chu, Fan, Lin and Wang 2004, Int. J. Control 77(8)), its derivative by a Lyapunov equation
through the closed loop A - K C (squared Smith iteration, Smith 1968). Directions that no sensor sees and no dynamics
damps (heading without a compass) would make P infinite; a very weak pseudo-measurement of every error state keeps it
finite without touching the gain of what is seen.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from greybox.errors import FitError
from greybox.estimation.engine import chart_jacobians, symbols
from greybox.estimation.record import UNSURE, Record
from greybox.model.dynamics import Dynamics
from greybox.symbolic import CASADI, FloatArray


class Linearisation:
    """A, G, C, D of a Dynamics at one state and command, and their derivatives in the active parameters.

    `fixed` (n_x entries or none): the values of state entries that never change, None where one does. Zeros and ones
    among them make the expressions, their construction and their evaluation smaller.
    """

    def __init__(self, dynamics: Dynamics, active: tuple[str, ...], fixed: tuple[float | None, ...] = ()) -> None:
        with CASADI:
            self._build(dynamics, active, fixed)

    def _build(self, dynamics: Dynamics, active: tuple[str, ...], fixed: tuple[float | None, ...]) -> None:
        s = symbols(dynamics)
        x, u, p, w, dt = s["x"], s["U"], s["p"], s["w"], s["dt"]
        names = [q.name for q in dynamics.parameters]
        chosen = [names.index(a) for a in active]
        after = dynamics.step(0, x, u, p, w, dt)
        y_hat = dynamics.output(0, x, u, p, w, dt)
        quiet = ca.DM.zeros(len(dynamics.noises))
        into, out = chart_jacobians(dynamics, x, after)
        y = ca.SX.sym("y", y_hat.numel())
        e = dynamics.innovation(y, y_hat, x)
        # At the reference the measured value equals the prediction.
        at = {"A": out @ ca.jacobian(after, x) @ into, "G": out @ ca.jacobian(after, w)}
        at |= {"C": -(ca.jacobian(e, x) @ into), "D": -ca.jacobian(e, w)}
        point = ca.vertcat(*(x[i] if v is None else v for i, v in enumerate(fixed))) if fixed else x
        parts = ca.substitute(ca.substitute(list(at.values()), [y], [y_hat]), [x, w], [point, quiet])
        self._shapes = [v.shape for v in parts]
        stacked = ca.vertcat(*(ca.densify(ca.vec(v)) for v in parts))
        slopes = ca.jacobian(stacked, p)[:, chosen] if chosen else ca.SX(stacked.numel(), 0)
        self._function = ca.Function("linearisation", [x, u, p, dt], [stacked, slopes])
        self._value_only = ca.Function("linearisation_value", [x, u, p, dt], [stacked])
        self._columns: npt.NDArray[np.int_] | None = None

    def select(self, columns: npt.NDArray[np.int_]) -> Linearisation:
        """The same linearisation with the derivatives in some of its active parameters only, at `columns` among them."""
        if len(columns) == self._function.size2_out(1):
            return self
        some = copy.copy(self)
        some._columns = columns
        return some

    def __call__(
        self, x: FloatArray, window: FloatArray, p: FloatArray, dt: float
    ) -> tuple[tuple[FloatArray, ...], tuple[FloatArray, ...]]:
        """((A, G, C, D), (dA, dG, dC, dD)); derivatives have the active parameter as first axis."""
        with CASADI:
            value, slope = (v.full() for v in self._function(x, window, p, dt))
        slopes = slope if self._columns is None else slope[:, self._columns]
        return self._unpack(value[:, 0][:, None], False), self._unpack(slopes, True)

    def values(self, x: FloatArray, window: FloatArray, p: FloatArray, dt: float) -> tuple[FloatArray, ...]:
        """(A, G, C, D)."""
        with CASADI:
            value = self._value_only(x, window, p, dt).full()
        return self._unpack(value, False)

    def _unpack(self, columns: Any, many: bool) -> tuple[FloatArray, ...]:
        out, at = [], 0
        for rows, cols in self._shapes:
            block = columns[at : at + rows * cols]
            at += rows * cols
            stack = np.ascontiguousarray(block.T.reshape(-1, cols, rows).transpose(0, 2, 1))
            out.append(stack if many else stack[0])
        return tuple(out)


def lost_command(dynamics: Dynamics, x: FloatArray, window: FloatArray, dt: float) -> FloatArray:
    """(n_d, n_d) covariance of the next state where the present command is not known, at the nominal parameters.

    It does not depend on what is fitted: the uncertainty is the log's.
    """
    with CASADI:
        try:
            push = _push(dynamics)  # type: ignore[arg-type]
        except TypeError:  # a model that cannot be hashed
            push = _push.__wrapped__(dynamics)
        b = push(x, window, [d.nominal for d in dynamics.parameters], dt).full()
    sigma = LOST * np.abs(window[:, dynamics.window[0]])
    # The voltage is slow: the row before has it.
    sigma[[n == "vbat" for n in dynamics.inputs.names]] = 0.0
    return np.asarray((b * sigma**2) @ b.T)


def lost_of(
    records: Iterable[Record], dynamics: Dynamics, x: FloatArray, window: FloatArray, dt: float
) -> FloatArray | None:
    """`lost_command` where a record has lost rows, else None."""
    if not any((r.patterns == UNSURE).any() for r in records):
        return None
    return lost_command(dynamics, x, window, dt)


@functools.lru_cache(maxsize=64)
def _push(dynamics: Dynamics) -> Any:
    """Derivative of the next error state in the present command, as a function of (x, window, p, dt)."""
    s = symbols(dynamics)
    x, u, p, w, dt = s["x"], s["U"], s["p"], s["w"], s["dt"]
    after = dynamics.step(0, x, u, p, w, dt)
    _, out = chart_jacobians(dynamics, x, after)
    b = out @ ca.jacobian(after, u[:, dynamics.window[0]])
    return ca.Function("push", [x, u, p, dt], [ca.densify(ca.substitute(b, w, ca.DM.zeros(len(dynamics.noises))))])


@functools.lru_cache(maxsize=64)
def _cached(dynamics: Dynamics, active: tuple[str, ...], fixed: tuple[float | None, ...]) -> Linearisation:
    return Linearisation(dynamics, active, fixed)


def linearisation_at(dynamics: Dynamics, active: tuple[str, ...], x: FloatArray, other: FloatArray) -> Linearisation:
    """The linearisation of a model for the state `x`, built once per process.

    `other` is the same kind of state from other data: where both agree the entry counts as fixed.
    """
    fixed = tuple(float(a) if a == b else None for a, b in zip(x, other, strict=True))
    try:
        return _cached(dynamics, tuple(active), fixed)  # type: ignore[arg-type]
    except TypeError:  # a model that cannot be hashed
        return Linearisation(dynamics, tuple(active), fixed)


LOST = 0.04
"""Standard deviation of a lost command about the one before, relative to the mean command."""


@dataclass(frozen=True, kw_only=True)
class Riccati:
    """Solution at one point: covariance P (n_d, n_d) of the predicted state, and the pieces that gains need.

    `lost` (n_d, n_d) is what a lost command adds to P for the next sample; `pieces` are A, C and, with slopes, dA, dC.
    """

    P: FloatArray
    N: FloatArray  # A P C' + G Q D', (n_d, n_e)
    S: FloatArray  # innovation covariance of all channels, (n_e, n_e)
    dP: FloatArray | None = None  # (n_s, n_d, n_d)
    dN: FloatArray | None = None
    dS: FloatArray | None = None
    lost: FloatArray | None = None
    pieces: tuple[FloatArray, ...] = ()

    @cached_property
    def _after_lost(self) -> Riccati:
        a, c, *slopes = self.pieces
        w: FloatArray = np.zeros_like(self.P) if self.lost is None else self.lost
        usual = Riccati(P=self.P + w, N=self.N + a @ w @ c.T, S=self.S + c @ w @ c.T)
        if not slopes or self.dN is None or self.dS is None:
            return usual
        da, dc = slopes
        side = dc @ w @ c.T
        return replace(
            usual,
            dP=self.dP,
            dN=self.dN + da @ (w @ c.T) + (a @ w) @ dc.transpose(0, 2, 1),
            dS=self.dS + side + side.transpose(0, 2, 1),
        )

    def gain(self, there: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray | None, FloatArray | None]:
        """(K, S, dK, dS) where only the channels with there[i] != 0 are measured; `UNSURE` follows a lost command.

        K (n_d, n_e) has zero columns for the others, S (n_e, n_e) unit diagonal there, so that both keep their size.
        """
        m = np.asarray(there) != 0
        if self.lost is not None and (np.asarray(there) == UNSURE).any():
            return self._after_lost.gain(m)
        ne = m.size
        s = np.eye(ne)
        s[np.ix_(m, m)] = self.S[np.ix_(m, m)]
        k = np.zeros_like(self.N)
        inverse = np.linalg.inv(s[np.ix_(m, m)])
        k[:, m] = self.N[:, m] @ inverse
        if self.dN is None or self.dS is None:
            return k, s, None, None
        ds = np.zeros_like(self.dS)
        ds[:, m[:, None] & m[None, :]] = self.dS[:, m[:, None] & m[None, :]]
        dk = np.zeros_like(self.dN)
        dk[:, :, m] = (self.dN[:, :, m] - k[:, m] @ ds[:, m][:, :, m]) @ inverse
        return k, s, dk, ds


def solve_riccati(
    a: FloatArray, g: FloatArray, c: FloatArray, d: FloatArray, q: FloatArray, r: FloatArray, weak: FloatArray
) -> FloatArray:
    """Stabilising P of the filter Riccati equation. q (n_w), r (n_e) are variances; weak (n_d) that of the pseudo-sensor.

    Raises `FitError` where the doubling does not converge.
    """
    n = a.shape[0]
    gq = g * q
    dq = d * q
    rt = np.diag(r) + dq @ d.T
    solved = np.linalg.solve(rt, np.column_stack([dq @ g.T, c]))  # R~^-1 [D Q G', C]
    cross = solved[:, :n].T  # G Q D' R~^-1
    ak = a - cross @ c
    hk = gq @ g.T - cross @ (dq @ g.T)
    hk = 0.5 * (hk + hk.T)
    gk = c.T @ solved[:, n:] + np.diag(1.0 / weak)
    gk = 0.5 * (gk + gk.T)
    # Balance: the states differ by orders of magnitude.
    scale = np.sqrt(np.maximum(np.diag(hk), 1e-12 * weak))
    ak = ak * scale[None, :] / scale[:, None]
    hk = hk / np.outer(scale, scale)
    gk = gk * np.outer(scale, scale)
    ak = ak.T  # filter form by duality
    eye = np.eye(n)
    for _ in range(60):
        w = eye + gk @ hk
        try:
            v1 = np.linalg.solve(w, ak)
            v2 = np.linalg.solve(w, gk)
        except np.linalg.LinAlgError:
            raise FitError("the Riccati equation of the predictor is singular") from None
        step = ak.T @ hk @ v1
        gk = gk + ak @ v2 @ ak.T
        ak = ak @ v1
        new = hk + 0.5 * (step + step.T)
        gk = 0.5 * (gk + gk.T)
        if not np.isfinite(new).all():
            break
        if np.abs(new - hk).max() <= 1e-14 * np.abs(new).max():
            return new * np.outer(scale, scale)
        hk = new
    raise FitError(
        "the Riccati equation of the predictor has no stationary solution",
        fix="measure the states that drift, or use the extended Kalman filter predictor",
    )


def stationary(
    values: tuple[FloatArray, ...],
    q: FloatArray,
    r: FloatArray,
    weak: FloatArray,
    slopes: tuple[FloatArray, ...] | None = None,
    dq: FloatArray | None = None,
    dr: FloatArray | None = None,
    lost: FloatArray | None = None,
) -> Riccati:
    """Riccati solution and, with `slopes` (dA, dG, dC, dD) and dq (n_s, n_w), dr (n_s, n_e), its derivatives.

    The first axis of all derivatives is the same list of parameters; slopes of model parameters may be shorter (the
    remaining parameters are noise levels, which do not move A, G, C, D). `lost` (n_d, n_d): see `lost_command`.
    """
    a, g, c, d = values
    p = solve_riccati(a, g, c, d, q, r, weak)
    gqd = (g * q) @ d.T
    n_ = a @ p @ c.T + gqd
    s = c @ p @ c.T + (d * q) @ d.T + np.diag(r)
    if slopes is None or dq is None or dr is None:
        return Riccati(P=p, N=n_, S=s, lost=lost, pieces=(a, c))
    # Gain of the problem with the pseudo-sensor (the one that P solves).
    full_s = np.block([[s, c @ p], [p @ c.T, p + np.diag(weak)]])
    full_k = np.column_stack([n_, a @ p]) @ np.linalg.inv(full_s)
    ke, kw = full_k[:, : r.size], full_k[:, r.size :]
    closed = a - ke @ c - kw
    through = g - ke @ d
    da, dg, dc, dd = (_extend(v, dq.shape[0]) for v in slopes)
    m = (da - ke @ dc) @ (p @ closed.T) + (dg - ke @ dd) @ ((through * q).T)
    m = m + m.transpose(0, 2, 1)
    m = m + (through * dq[:, None, :]) @ through.T + (ke * dr[:, None, :]) @ ke.T
    dp = _smith(closed, m)
    pc = p @ c.T
    dn = da @ pc + a @ dp @ c.T + (a @ p) @ dc.transpose(0, 2, 1)
    dn = dn + (dg * q) @ d.T + (g * dq[:, None, :]) @ d.T + (g * q) @ dd.transpose(0, 2, 1)
    half = dc @ pc + (dd * q) @ d.T
    ds = half + half.transpose(0, 2, 1) + c @ dp @ c.T + (d * dq[:, None, :]) @ d.T
    ds[:, np.arange(r.size), np.arange(r.size)] += dr
    return Riccati(P=p, N=n_, S=s, dP=dp, dN=dn, dS=ds, lost=lost, pieces=(a, c, da, dc))


def _extend(stack: FloatArray, n: int) -> FloatArray:
    if stack.shape[0] == n:
        return stack
    return np.concatenate([stack, np.zeros((n - stack.shape[0], *stack.shape[1:]))])


def _smith(closed: FloatArray, m: FloatArray) -> FloatArray:
    """X = closed X closed' + M for a stack of M, by squaring."""
    x, f = m, closed
    for _ in range(60):
        step = f @ x @ f.T
        x = x + step
        if np.abs(step).max() <= 1e-15 * max(float(np.abs(x).max()), 1e-300):
            return x
        f = f @ f
    return x
