"""OutputController: model predictive control of the outputs of any exported model.

    min  1/2 sum_k |w (y_k - r)|^2 + |w_d (u_k - u_(k-1))|^2 + |M u_k - m|^2 + penalty w (s_k + 5 w s_k^2)
    s.t. lower + kappa sigma_k - s_k <= y_k <= upper - kappa sigma_k + s_k,  u_min <= u_k <= u_max,  k = 0 .. N - 1

y_k is linearised along the plan before (one real-time iteration a sample, Diehl et al. 2005, SIAM
J. Control and Optimization 43(5)); r and m are held over the horizon. sigma_k is what the model says
of y_k (mpc_export/outputs/stages.py) under the gain of a finite Riccati recursion, as the real loop
plans anew (Hewing, Kabzan and Zeilinger 2020, IEEE Trans. Control Systems Technology 28(6)).
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import casadi as ca
import numpy as np

from greybox.errors import ModelError
from greybox.symbolic import FloatArray
from mpc_export.functions import ModelFunctions
from mpc_export.outputs.beginning import Beginning
from mpc_export.outputs.stages import output_stages
from mpc_export.tube.native import native

TIGHTEST = 0.3
"""No range of an output is tightened to less than this share of itself: the plan's end is not where
the machine will be."""
RICCATI = 30
"""Steps of the recursion that the gain of the tube comes from."""
CHANGE = 0.3
"""What a change of a command by its whole range costs, in typical sizes of an output."""


@dataclass(frozen=True, kw_only=True, eq=False)
class OutputProblem:
    """`weights` (n_y,) [1/unit of y], limits `lower`, `upper` (n_y,), infinite where there are
    none, `change` (n_u,) [1/unit of u], `u_min`, `u_max` (n_u,), `penalty` per weighted unit beyond
    a limit at any stage; `drawn` (n_m, n_u) is M. Raises `ModelError`."""

    weights: FloatArray
    lower: FloatArray
    upper: FloatArray
    change: FloatArray
    u_min: FloatArray
    u_max: FloatArray
    horizon: int = 20
    penalty: float = 50.0
    drawn: FloatArray | None = None

    def __post_init__(self) -> None:
        good = {
            "every output needs room between its limits": bool((self.lower < self.upper).all()),
            "the horizon has at least 2 stages": self.horizon >= 2,
            "weights must be finite and not negative": all(
                bool((np.isfinite(v) & (np.asarray(v) >= 0)).all())
                for v in (self.weights, self.change, self.penalty)
            ),
            "limits of commands must be finite, the lower below the upper": bool(
                np.isfinite([self.u_min, self.u_max]).all() and (self.u_min < self.u_max).all()
            ),
        }
        for text, holds in good.items():
            if not holds:
                raise ModelError(f"output controller: {text}")


@dataclass(frozen=True, kw_only=True)
class OutputPlan:
    """`y` (N, n_y) planned outputs and their standard deviations `sigma` (N, n_y), commands `u` (N,
    n_u), solved or not, `seconds` that it took."""

    y: FloatArray
    sigma: FloatArray
    u: FloatArray
    solved: bool
    seconds: float


class OutputController:
    """Commands from measured outputs, sample by sample; `kappa` standard deviations are kept from
    the limits.

    `functions` are those of a model exported with "covariance" and "filter". Raises `BuildError`
    without a compiler.
    """

    def __init__(
        self, functions: ModelFunctions, outputs: OutputProblem, *, kappa: float = 0.0
    ) -> None:
        self.outputs, self.kappa, self.functions = outputs, kappa, functions
        f, n = functions, outputs.horizon
        self._n_u, self._n_y = len(f.inputs), len(f.outputs)
        drawn = np.zeros((0, self._n_u)) if outputs.drawn is None else outputs.drawn
        self._filter = native(f["filter_step"])
        self._stages = native(output_stages(f, n, self._ancillary(drawn)))
        self.reference = f.reference
        self._begun = Beginning(f)
        self._limited = np.flatnonzero(np.isfinite(outputs.lower) | np.isfinite(outputs.upper))
        slacks = len(self._limited) * n
        wide = self._n_u * n + slacks
        pattern = {"h": ca.Sparsity.dense(wide, wide), "a": ca.Sparsity.dense(2 * slacks, wide)}
        self._solve = ca.conic("outputs", "daqp", pattern, {"error_on_fail": False})
        self._shift = np.eye(self._n_u * n) - np.eye(self._n_u * n, k=-self._n_u)
        self._drawn = np.kron(np.eye(n), drawn)
        self._pace = np.tile(outputs.change**2, n)
        self._smooth = (
            self._shift.T @ (self._pace[:, None] * self._shift) + self._drawn.T @ self._drawn
        )
        self.start()

    def _ancillary(self, drawn: FloatArray) -> FloatArray:
        """Gain (n_u, n_d) at the model's typical point, of `RICCATI` steps of the recursion."""
        f, outputs = self.functions, self.outputs
        x, u = f.reference
        _, a, b, _ = (v.full() for v in f["f_d_jac"](x, u, f.parameter_values))
        c = outputs.weights[:, None] * f["h_jac"](x, u, f.parameter_values)[1].full()
        q = c.T @ c + 1e-9 * np.eye(len(a))
        r = np.diag(outputs.change**2) + drawn.T @ drawn
        p, gain = q, np.zeros((b.shape[1], len(a)))
        for _ in range(RICCATI):
            gain = -np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)
            p = q + a.T @ p @ (a + b @ gain)
        return gain

    def start(self, u: FloatArray | None = None) -> None:
        """Forget everything; `u` (n_u,) is the command that acts now, default the model's typical
        one, within the limits."""
        x, typical = self.reference
        self.x = np.array(x, dtype=float)
        self._first = True
        within = np.clip(typical, self.outputs.u_min, self.outputs.u_max)
        self.u = np.array(within if u is None else u, dtype=float)
        self.p = self.functions.parameter_values.copy()
        self.nominal = np.tile(self.u, (self.outputs.horizon, 1))
        self.plan: OutputPlan | None = None
        self.failures = 0

    def answer(
        self,
        y: FloatArray,
        goal: FloatArray,
        drawn: FloatArray | None = None,
        p: FloatArray | None = None,
    ) -> FloatArray:
        """The command (n_u,) from the next sample on: y (n_y,) was measured under the present one,
        what is not finite was not; asked are the outputs `goal` (n_y,) and M u = `drawn` (n_m,). `p`
        (n_p,) holds from now on (default: as before)."""
        began = time.perf_counter()
        self._filtered(y)
        self.p = self.p if p is None else p
        nominal = np.vstack([self.nominal[1:], self.nominal[-1:]])
        y0, slope, sigma = self._linearised(nominal)
        aim = np.zeros(0) if drawn is None else drawn
        moved, solved = self._step(nominal, y0, slope, sigma, goal, aim)
        if not solved:
            self.failures += 1
        n = self.outputs.horizon
        self.nominal = np.clip(
            nominal + moved.reshape(n, -1), self.outputs.u_min, self.outputs.u_max
        )
        foretold = (y0.ravel() + slope @ moved).reshape(n, -1)
        self.plan = OutputPlan(
            y=foretold,
            sigma=sigma,
            u=self.nominal,
            solved=solved,
            seconds=time.perf_counter() - began,
        )
        self.u = self.nominal[0]
        return self.u

    def _filtered(self, y: FloatArray) -> None:
        """The state (n_x,) after y (n_y,) was measured, and one sample on; what does not come out
        finite is foretold without y, or stays."""
        there = np.isfinite(y).astype(float)
        if self._first:
            self._first, self.x = False, self._begun.start(self.x, y)
        after, e, _ = self._filter(self.x, self.u, self.p, np.where(there != 0, y, 0.0), there)
        found, x = after.ravel(), self.x
        if not np.isfinite(found).all():
            blind = self.functions["f_d"](x, self.u, self.p).full().ravel()
            found = np.where(np.isfinite(found), found, np.where(np.isfinite(blind), blind, x))
        self.x = found
        if not self._begun.settled:
            settled = self.functions["innovation_gain"](there)[0].full()
            more = self._begun.gain(there) - settled
            moved = more @ np.where(there != 0, e.ravel(), 0.0)
            if np.isfinite(moved).all():
                self.x = self.functions["boxplus"](self.x, moved).full().ravel()

    def margins(self) -> FloatArray:
        """(n_y,) How far the planned outputs of the next sample stay inside the tightened
        limits."""
        assert self.plan is not None
        back, y = self.kappa * self.plan.sigma[1], self.plan.y[1]
        return np.asarray(np.minimum(self.outputs.upper - back - y, y - self.outputs.lower - back))

    def _linearised(self, nominal: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """y (N, n_y) along the commands, its slope (N n_y, N n_u) in them, standard deviations (N,
        n_y)."""
        found = self._stages(self.x, nominal.T, self.p, self._begun.covariance)
        n, n_u, n_y, n_x = self.outputs.horizon, self._n_u, self._n_y, self.functions.sizes["n_d"]
        y, variance = found[0].T, found[1].T
        a, b = found[2].reshape(n_x, n, n_x), found[3].reshape(n_x, n, n_u)
        c, d = found[4].reshape(n_y, n, n_x), found[5].reshape(n_y, n, n_u)
        moved, slope = np.zeros((n_x, n * n_u)), np.zeros((n, n_y, n * n_u))
        for k in range(n):
            at = slice(k * n_u, (k + 1) * n_u)
            slope[k] = c[:, k] @ moved
            slope[k][:, at] += d[:, k]
            moved = a[:, k] @ moved
            moved[:, at] += b[:, k]
        return y, slope.reshape(n * n_y, -1), np.sqrt(np.maximum(variance, 0.0))

    def _step(
        self,
        nominal: FloatArray,
        y: FloatArray,
        slope: FloatArray,
        sigma: FloatArray,
        goal: FloatArray,
        drawn: FloatArray,
    ) -> tuple[FloatArray, bool]:
        """(change of the commands (N n_u,), solved): the quadratic programme of one sample."""
        o, n, wide = self.outputs, self.outputs.horizon, self._n_u * self.outputs.horizon
        flat = nominal.ravel()
        before = self._shift @ flat
        before[: self._n_u] -= self.u
        limited = self._limited
        slacks = len(limited) * n
        # One slack per output and stage: a breach that cannot be helped frees no other stage.
        weighted = np.tile(o.weights, n)[:, None] * slope
        own = np.tile(self._limit_weights(), n)
        hessian = np.zeros((wide + slacks, wide + slacks))
        hessian[:wide, :wide] = weighted.T @ weighted + self._smooth
        hessian[wide:, wide:] = 10.0 * o.penalty * np.diag(own**2)
        gradient = np.concatenate([np.zeros(wide), o.penalty * own])
        gradient[:wide] = weighted.T @ (o.weights * (y - goal)).ravel()
        gradient[:wide] += self._shift.T @ (self._pace * before)
        gradient[:wide] += self._drawn.T @ (self._drawn @ flat - np.tile(drawn, n))
        back = np.minimum(self.kappa * sigma, 0.5 * (1 - TIGHTEST) * (o.upper - o.lower))
        low, high = (v[:, limited].ravel() for v in (o.lower + back - y, o.upper - back - y))
        part = slope.reshape(n, self._n_y, wide)[:, limited].reshape(slacks, wide)
        rows = np.vstack([np.hstack([part, -np.eye(slacks)]), np.hstack([-part, -np.eye(slacks)])])
        most = np.concatenate([high, -low])
        whole = all(np.isfinite(v).all() for v in (hessian, gradient, rows, flat))
        if not whole or not (most > -np.inf).all():  # the solver raises or does not end
            return np.zeros(wide), False
        found = self._solve(
            h=hessian,
            g=gradient,
            a=rows,
            lba=-np.inf,
            uba=most,
            lbx=np.concatenate([np.tile(o.u_min, n) - flat, np.zeros(slacks)]),
            ubx=np.concatenate([np.tile(o.u_max, n) - flat, np.full(slacks, np.inf)]),
        )
        change = found["x"].full().ravel()[:wide]
        solved = bool(self._solve.stats()["success"]) and bool(np.isfinite(change).all())
        return (change if solved else np.zeros(wide)), solved

    def _limit_weights(self) -> FloatArray:
        """Weights of the limited outputs: what is not tracked is weighed by its room."""
        o = self.outputs
        room = o.upper - o.lower
        plain = np.where(np.isfinite(room), 2.0 / np.where(np.isfinite(room), room, 1.0), 1.0)
        return np.where(o.weights > 0, o.weights, plain)[self._limited]


def typical_problem(
    f: ModelFunctions,
    *,
    held: tuple[str, ...],
    lower: FloatArray,
    upper: FloatArray,
    u_min: FloatArray,
    u_max: FloatArray,
    horizon: int,
) -> OutputProblem:
    """The problem of holding the outputs `held`: errors count by the typical size of their output,
    changes of a command by their share of its range (`CHANGE`)."""
    sizes = f.scales[2]
    weights = np.array(
        [1 / s if n in held else 0.0 for n, s in zip(f.outputs.names, sizes, strict=True)]
    )
    return OutputProblem(
        weights=weights,
        lower=lower,
        upper=upper,
        change=CHANGE / (u_max - u_min),
        u_min=u_min,
        u_max=u_max,
        horizon=horizon,
    )
