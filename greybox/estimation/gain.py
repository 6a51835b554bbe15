"""Stationary Kalman gain of a linearised Dynamics, and its exact derivative with respect to all
parameters.

Linearisation at a reference point, with process noise w ~ (0, Q) that enters state and output
alike:

    d+ = A d + G w,   e = C d + D w + v,   v ~ (0, R)
    P = A P A' + G Q G' - K S K',   S = C P C' + D Q D' + R,   K = (A P C' + G Q D') S^-1

(Anderson and Moore 1979, Optimal Filtering, ch. 4 and sec. 5.4 for correlated noise.) The Riccati
equation is solved by structure-preserving doubling (Chu, Fan, Lin and Wang 2004, Int. J. Control
77(8)), its derivative by a Lyapunov equation through the closed loop A - K C (squared Smith
iteration, Smith 1968). Directions that no sensor sees and no dynamics damps (heading without a
compass) would make P infinite; a very weak pseudo-measurement of every error state keeps it finite
without touching the gain of what is seen.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Sequence
from dataclasses import dataclass, field

import casadi as ca
import numpy as np
import numpy.typing as npt

from greybox.errors import FitError
from greybox.estimation.elements import stack_times
from greybox.estimation.point_functions import PointFunction
from greybox.estimation.reference_point import (
    Fixed,
    Reference,
    ReferenceStep,
    once_per_model,
    unchanging,
)
from greybox.model.dynamics import Dynamics
from greybox.symbolic import Expr, FloatArray


class Linearisation:
    """A, G, C, D of a Dynamics at one state and command, and their derivatives in the active
    parameters. They are derived when they are asked for.

    `fixed` as in `ReferenceStep.at_point`.
    """

    def __init__(self, dynamics: Dynamics, active: tuple[str, ...], fixed: Fixed = ()) -> None:
        self._active = tuple(active)
        reference = Reference(dynamics, self._active, fixed)
        self._functions = PointFunction(reference, "linearisation", _stacked)
        nd, ne, nw = (
            len(v) for v in (dynamics.error_states, dynamics.innovations, dynamics.noises)
        )
        self._shapes = [(nd, nd), (nd, nw), (ne, nd), (ne, nw)]
        self._columns: npt.NDArray[np.int_] | None = None

    def select(self, columns: npt.NDArray[np.int_]) -> Linearisation:
        """The same linearisation with the derivatives in some of its active parameters only, at
        `columns` among them."""
        if len(columns) == len(self._active):
            return self
        some = copy.copy(self)
        some._columns = columns
        return some

    def __call__(
        self, x: FloatArray, window: FloatArray, p: FloatArray, dt: float
    ) -> tuple[tuple[FloatArray, ...], tuple[FloatArray, ...]]:
        """((A, G, C, D), (dA, dG, dC, dD)); derivatives have the active parameter as first axis."""
        values, slopes = self._functions.with_slopes(x, window, p, dt)
        some = slopes if self._columns is None else slopes[self._columns]
        return self._unpack(values[None], False), self._unpack(some, True)

    def values(
        self, x: FloatArray, window: FloatArray, p: FloatArray, dt: float
    ) -> tuple[FloatArray, ...]:
        """(A, G, C, D)."""
        return self._unpack(self._functions.values(x, window, p, dt)[None], False)

    def _unpack(self, stacked: FloatArray, many: bool) -> tuple[FloatArray, ...]:
        out, at = [], 0
        for rows, cols in self._shapes:
            block = stacked[:, at : at + rows * cols]
            at += rows * cols
            stack = np.ascontiguousarray(block.reshape(-1, cols, rows).transpose(0, 2, 1))
            out.append(stack if many else stack[0])
        return tuple(out)


def _stacked(at: ReferenceStep) -> Expr:
    """(A, G, C, D) of a model's step, column by column."""
    a = at.out @ ca.jacobian(at.after, at.x) @ at.into
    g = at.out @ ca.jacobian(at.after, at.w)
    c, d = -(ca.jacobian(at.e, at.x) @ at.into), -ca.jacobian(at.e, at.w)
    return ca.vertcat(*(ca.densify(ca.vec(v)) for v in at.at_rest([a, g, c, d])))


_built = once_per_model(Linearisation)


def linearisation_anywhere(dynamics: Dynamics) -> Linearisation:
    """The linearisation of a model for any state, without derivatives, built once per process."""
    return _built(dynamics, (), ())


def linearisation_at(
    dynamics: Dynamics, active: tuple[str, ...], x: FloatArray, other: FloatArray
) -> Linearisation:
    """The linearisation of a model for the state `x`, built once per process.

    `other` is the same kind of state from other data: where both agree the entry counts as fixed.
    """
    return _built(dynamics, tuple(active), unchanging(x, other))


@dataclass(frozen=True, kw_only=True)
class GainRow:
    """Gain K (n_d, n_e) and innovation covariance S (n_e, n_e) of some channels, with dK (n_s, n_d,
    n_e), dS (n_s, ...)."""

    K: FloatArray
    S: FloatArray
    dK: FloatArray | None
    dS: FloatArray | None


@dataclass(frozen=True, kw_only=True)
class Riccati:
    """Solution at one point: covariance P (n_d, n_d) of the predicted state, and the pieces that
    gains need."""

    P: FloatArray
    N: FloatArray  # A P C' + G Q D', (n_d, n_e)
    S: FloatArray  # innovation covariance of all channels, (n_e, n_e)
    dP: FloatArray | None = None  # (n_s, n_d, n_d)
    dN: FloatArray | None = None
    dS: FloatArray | None = None
    _rows: dict[bytes, GainRow] = field(default_factory=dict, init=False, repr=False, compare=False)

    def row(self, there: FloatArray) -> GainRow:
        """`gain` as a row of a gain table; made once."""
        key = there.tobytes()
        if key not in self._rows:
            k, s, dk, ds = self.gain(there)
            self._rows[key] = GainRow(K=k, S=s, dK=dk, dS=ds)
        return self._rows[key]

    def gain(
        self, there: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray | None, FloatArray | None]:
        """(K, S, dK, dS) where only the channels with there[i] != 0 are measured, as in
        `Record.patterns`.

        K (n_d, n_e) has zero columns for the others, S (n_e, n_e) unit diagonal there, so that both
        keep their size.
        """
        m = np.asarray(there) != 0
        if m.all() and self.dN is not None and self.dS is not None:
            k, dk = _gain(self.N, self.S, self.dN, self.dS)
            return k, self.S, dk, self.dS
        at = np.flatnonzero(m)
        square = np.ix_(at, at)
        s, k = np.eye(m.size), np.zeros_like(self.N)
        s[square] = self.S[square]
        if self.dN is None or self.dS is None:
            k[:, at] = _gain(self.N[:, at], s[square])[0]
            return k, s, None, None
        inner, ds, dk = self.dS[:, at[:, None], at], np.zeros_like(self.dS), np.zeros_like(self.dN)
        ds[:, at[:, None], at] = inner
        k[:, at], dk[:, :, at] = _gain(self.N[:, at], s[square], self.dN[:, :, at], inner)
        return k, s, dk, ds


def rows_of(pairs: Sequence[tuple[Riccati, FloatArray]]) -> list[GainRow]:
    """`Riccati.row` of every pair of a solution and its channels; those without slopes side by
    side."""
    waiting = dict[bytes, dict[int, Riccati]]()
    for solution, there in pairs:
        if solution.dN is None and there.tobytes() not in solution._rows:
            waiting.setdefault(there.tobytes(), {})[id(solution)] = solution
    for key, solutions in waiting.items():
        there = np.frombuffer(key, dtype=pairs[0][1].dtype)
        for solution, row in zip(
            solutions.values(), _side_by_side([*solutions.values()], there), strict=True
        ):
            solution._rows[key] = row
    return [solution.row(there) for solution, there in pairs]


def _side_by_side(solutions: Sequence[Riccati], there: FloatArray) -> list[GainRow]:
    """`Riccati.gain` of solutions without slopes."""
    at = np.flatnonzero(there)
    s = np.tile(np.eye(there.size), (len(solutions), 1, 1))
    inner = np.array([v.S for v in solutions])[:, at[:, None], at]
    s[:, at[:, None], at] = inner
    k = np.zeros((len(solutions), *solutions[0].N.shape))
    k[:, :, at] = np.array([v.N for v in solutions])[:, :, at] @ np.linalg.inv(inner)
    return [GainRow(K=a, S=b, dK=None, dS=None) for a, b in zip(k, s, strict=True)]


def _gain(
    n: FloatArray, s: FloatArray, dn: FloatArray | float = 0.0, ds: FloatArray | float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """K = N S^-1 and its slopes."""
    inverse = np.linalg.inv(s)
    k = n @ inverse
    return k, (dn - k @ ds) @ inverse if np.ndim(ds) else np.zeros(0)


def solve_riccati(
    a: FloatArray,
    g: FloatArray,
    c: FloatArray,
    d: FloatArray,
    q: FloatArray,
    r: FloatArray,
    weak: FloatArray,
) -> FloatArray:
    """Stabilising P of the filter Riccati equation. q (n_w), r (n_e) are variances; weak (n_d) that
    of the pseudo-sensor.

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
) -> Riccati:
    """Riccati solution and, with `slopes` (dA, dG, dC, dD) and dq (n_s, n_w), dr (n_s, n_e), its
    derivatives.

    The first axis of all derivatives is the same list of parameters; slopes of model parameters may
    be shorter (the remaining parameters are noise levels, which do not move A, G, C, D).
    """
    a, g, c, d = values
    p = solve_riccati(a, g, c, d, q, r, weak)
    samples = SystemSamples(values=values, q=q, r=r, slopes=slopes, dq=dq, dr=dr)
    if slopes is None or dq is None or dr is None:
        return samples.at(p)
    gqd = (g * q) @ d.T
    n_ = a @ p @ c.T + gqd
    s = c @ p @ c.T + (d * q) @ d.T + np.diag(r)
    # Gain of the problem with the pseudo-sensor (the one that P solves).
    full_s = np.block([[s, c @ p], [p @ c.T, p + np.diag(weak)]])
    full_k = np.column_stack([n_, a @ p]) @ np.linalg.inv(full_s)
    ke, kw = full_k[:, : r.size], full_k[:, r.size :]
    closed = a - ke @ c - kw
    through = g - ke @ d
    da, dg, dc, dd = (extended(v, dq.shape[0]) for v in slopes)
    m = (da - ke @ dc) @ (p @ closed.T) + (dg - ke @ dd) @ ((through * q).T)
    m = m + m.transpose(0, 2, 1)
    m = m + (through * dq[:, None, :]) @ through.T + (ke * dr[:, None, :]) @ ke.T
    return samples.at(p, smith(closed, m))


@dataclass(frozen=True, kw_only=True)
class SystemSamples:
    """Linear system seen sample by sample: what gains need, from the covariance of the predicted
    state there.

    values (A, G, C, D), q, r, slopes, dq, dr as in `stationary`. N and S are P times
    something and what does not depend on P, which is made once.
    """

    values: tuple[FloatArray, ...]
    q: FloatArray
    r: FloatArray
    slopes: tuple[FloatArray, ...] | None = None
    dq: FloatArray | None = None
    dr: FloatArray | None = None

    @functools.cached_property
    def _fixed(self) -> tuple[FloatArray, FloatArray]:
        _, g, _, d = self.values
        return (g * self.q) @ d.T, (d * self.q) @ d.T + np.diag(self.r)

    @functools.cached_property
    def _slopes(self) -> tuple[FloatArray, ...] | None:
        """dA, dC of the model's parameters; the slopes of what does not depend on P, of all
        unknowns."""
        if self.slopes is None or self.dq is None or self.dr is None:
            return None
        (_, g, _, d), q, n = self.values, self.q, self.dq.shape[0]
        dg, dd = (extended(v, n) for v in self.slopes[1::2])
        dn = (dg * q) @ d.T + (g * self.dq[:, None, :]) @ d.T + (g * q) @ dd.transpose(0, 2, 1)
        half = (dd * q) @ d.T
        ds = half + half.transpose(0, 2, 1) + (d * self.dq[:, None, :]) @ d.T
        ds[:, np.arange(self.r.size), np.arange(self.r.size)] += self.dr
        return self.slopes[0], self.slopes[2], dn, ds

    def at(self, p: FloatArray, dp: FloatArray | None = None) -> Riccati:
        """The solution where the predicted state has the covariance `p` (n_d, n_d) with slopes `dp`
        (n_s, n_d, n_d)."""
        a, _, c, _ = self.values
        pc = p @ c.T
        n_, s = a @ pc + self._fixed[0], c @ pc + self._fixed[1]
        if dp is None or self._slopes is None:
            return Riccati(P=p, N=n_, S=s)
        da, dc, fixed_n, fixed_s = self._slopes
        own = len(da)
        dpc = stack_times(dp, c.T)
        dn, ds = fixed_n + a @ dpc, fixed_s + c @ dpc
        half = stack_times(dc, pc)
        dn[:own] += stack_times(da, pc) + (a @ p) @ dc.transpose(0, 2, 1)
        ds[:own] += half + half.transpose(0, 2, 1)
        return Riccati(P=p, N=n_, S=s, dP=dp, dN=dn, dS=ds)


def extended(stack: FloatArray | None, n: int) -> FloatArray:
    """A stack of slopes with zeros for the remaining of n unknowns."""
    assert stack is not None
    if stack.shape[0] == n:
        return stack
    return np.concatenate([stack, np.zeros((n - stack.shape[0], *stack.shape[1:]))])


def smith(closed: FloatArray, m: FloatArray) -> FloatArray:
    """X = closed X closed' + M for a stack of M, by squaring."""
    x, f = m, closed
    for _ in range(60):
        step = f @ x @ f.T
        x = x + step
        if np.abs(step).max(initial=0.0) <= 1e-15 * max(np.abs(x).max(initial=0.0), 1e-300):
            return x
        f = f @ f
    return x
