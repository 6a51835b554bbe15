"""RateController: model predictive control of body rates on any exported predictor of them.

    min  1/2 sum_k |y_k - r|^2 + w_c^2 (mean u_k - c)^2 + w_d^2 |u_k - u_(k-1)|^2 + penalty (s_k + 5 s_k^2)
    s.t. |y_k| <= limit - kappa sigma_k + s_k,  u_min <= u_k <= u_max,  k = 0 .. N - 1

y_k is linearised along the plan before (one real-time iteration a sample, Diehl et al. 2005, SIAM
J. Control and Optimization 43(5)); r (rates) and c (collective command) are held over the horizon.
sigma_k is what the predictor says of y_k: innovations still to come, and the process's own error as
the same over the horizon, both under the gain of a finite Riccati recursion, as the real loop plans
anew (Hewing, Kabzan and Zeilinger 2020, IEEE Trans. Control Systems Technology 28(6)).
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from greybox.errors import ModelError
from greybox.symbolic import FloatArray
from mpc_export.functions import ModelFunctions, model_functions
from mpc_export.predictors import PredictorModel
from mpc_export.tube.native import native

TIGHTEST = 0.3
"""No limit is tightened below this share of itself: the plan's end is not where the craft will
be."""
GIVEN = ("phi[t-1]", "theta[t-1]")
FORM = "one slack per rate and stage"
"""Of the programme: flights that were flown with another form do not count with those of this
one."""


@dataclass(frozen=True, kw_only=True)
class RateProblem:
    """Horizon and weights: `limit` [rad/s], `collective` and `change` [rad/s per unit of command],
    `penalty` per rad/s beyond a limit at any stage."""

    limit: float
    horizon: int = 15
    collective: float = 10.0
    change: float = 6.0
    penalty: float = 50.0
    u_min: float = 0.05
    u_max: float = 0.95

    def __post_init__(self) -> None:
        good = {
            "the limit must be positive": math.isfinite(self.limit) and self.limit > 0,
            "the horizon has at least 2 stages": self.horizon >= 2,
            "weights must be finite and not negative": all(
                math.isfinite(v) and v >= 0 for v in (self.collective, self.change, self.penalty)
            ),
            "limits of commands must be finite, u_min below u_max": -math.inf
            < self.u_min
            < self.u_max
            < math.inf,
        }
        for text, holds in good.items():
            if not holds:
                raise ModelError(f"rate controller: {text}")


@dataclass(frozen=True, kw_only=True)
class RatePlan:
    """`y` (N, n_y) planned rates and their standard deviations `sigma` (N, n_y) [rad/s], commands
    `u` (N, n_u), solved or not, `seconds` that it took."""

    y: FloatArray
    sigma: FloatArray
    u: FloatArray
    solved: bool
    seconds: float


class RateController:
    """Commands from rates, sample by sample; `kappa` standard deviations are kept from the limits.

    Raises `ModelError` for a predictor that looks at measurements other than roll and pitch,
    `BuildError` without a compiler.
    """

    def __init__(self, model: PredictorModel, problem: RateProblem, *, kappa: float = 0.0) -> None:
        self.problem, self.kappa = problem, kappa
        self.functions = f = model_functions(model, with_=("covariance", "filter"))
        strange = [n for n in f.parameters.names if n not in GIVEN]
        if strange:
            raise ModelError(
                "the rate controller measures roll, pitch and rates",
                got=", ".join(strange),
                expected=", ".join(GIVEN),
                fix="learn with features that it has",
            )
        self._filter = native(f["filter_step"])
        self.reference = f.reference
        self._stages = native(_stages(f, problem.horizon, self._ancillary()))
        self._place = [GIVEN.index(n) for n in f.parameters.names]
        n = problem.horizon
        self._n_u, self._n_y = len(f.inputs), len(f.outputs)
        wide = (self._n_u + self._n_y) * n
        pattern = {
            "h": ca.Sparsity.dense(wide, wide),
            "a": ca.Sparsity.dense(2 * self._n_y * n, wide),
        }
        self._solve = ca.conic("rates", "daqp", pattern, {"error_on_fail": False})
        shift = np.eye(self._n_u * n) - np.eye(self._n_u * n, k=-self._n_u)
        mean = np.kron(np.eye(n), np.ones((1, self._n_u)) / self._n_u)
        self._shift, self._mean = shift, mean
        self._smooth = problem.change**2 * shift.T @ shift + problem.collective**2 * mean.T @ mean
        self.start()

    def _ancillary(self) -> FloatArray:
        """Gain (n_u, n_d) at the predictor's typical point, of 30 steps of the Riccati
        recursion."""
        f, problem = self.functions, self.problem
        x, u = f.reference
        _, a, b, _ = (v.full() for v in f["f_d_jac"](x, u, f.parameter_values))
        c = f["h_jac"](x, u, f.parameter_values)[1].full()
        q = c.T @ c + 1e-9 * np.eye(len(a))
        n_u = b.shape[1]
        r = (problem.change**2) * np.eye(n_u) + (problem.collective / n_u) ** 2 * np.ones(
            (n_u, n_u)
        )
        p, gain = q, np.zeros((n_u, len(a)))
        for _ in range(30):
            gain = -np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)
            p = q + a.T @ p @ (a + b @ gain)
        return gain

    def start(self, u: FloatArray | None = None) -> None:
        """Forget everything; `u` (n_u,) is the command that acts now, default the predictor's
        typical one."""
        x, typical = self.reference
        self.x = np.array(x, dtype=float)
        self.u = np.array(typical if u is None else u, dtype=float)
        self.p = np.zeros(len(self._place))
        self.nominal = np.tile(self.u, (self.problem.horizon, 1))
        self.plan: RatePlan | None = None
        self.failures = 0

    def sample(
        self, y: FloatArray, attitude: tuple[float, float], rates: FloatArray, collective: float
    ) -> FloatArray:
        """The command (n_u,) from the next sample on: y (n_y,) was measured under the present one;
        roll and pitch [rad] belong to it; asked are rates (n_y,) [rad/s] and the mean of the
        commands. What is not finite was not measured."""
        began = time.perf_counter()
        there = np.isfinite(y)
        self.x = (
            self._filter(self.x, self.u, self.p, np.where(there, y, 0.0), there.astype(float))[0]
            .full()
            .ravel()
        )
        angles = np.array(attitude)[self._place]
        self.p = np.where(np.isfinite(angles), angles, self.p)
        nominal = np.vstack([self.nominal[1:], self.nominal[-1:]])
        y0, slope, sigma = self._linearised(nominal)
        moved, solved = self._step(nominal, y0, slope, sigma, rates, collective)
        if not solved:
            self.failures += 1
        n = self.problem.horizon
        self.nominal = np.clip(
            nominal + moved.reshape(n, -1), self.problem.u_min, self.problem.u_max
        )
        foretold = (y0.ravel() + slope @ moved).reshape(n, -1)
        self.plan = RatePlan(
            y=foretold,
            sigma=sigma,
            u=self.nominal,
            solved=solved,
            seconds=time.perf_counter() - began,
        )
        self.u = self.nominal[0]
        return self.u

    def margins(self) -> FloatArray:
        """(n_y,) How far the planned rates of the next sample stay inside the limits [rad/s]."""
        assert self.plan is not None
        return np.asarray(
            self.problem.limit - self.kappa * self.plan.sigma[1] - np.abs(self.plan.y[1])
        )

    def _linearised(self, nominal: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """y (N, n_y) along the commands, its slope (N n_y, N n_u) in them, standard deviations (N,
        n_y)."""
        found = [v.full() for v in self._stages(self.x, nominal.T, self.p)]
        n, n_u, n_y, n_x = self.problem.horizon, self._n_u, self._n_y, len(self.x)
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
        rates: FloatArray,
        collective: float,
    ) -> tuple[FloatArray, bool]:
        """(change of the commands (N n_u,), solved): the quadratic programme of one sample."""
        problem, n_y, n = self.problem, self._n_y, self.problem.horizon
        flat, wide = nominal.ravel(), self._n_u * n
        before = self._shift @ flat
        before[: self._n_u] -= self.u
        slacks = (
            n_y * n
        )  # one per rate and stage: a breach that cannot be helped frees no other stage
        hessian = np.zeros((wide + slacks, wide + slacks))
        hessian[:wide, :wide] = slope.T @ slope + self._smooth
        hessian[wide:, wide:] = 10.0 * problem.penalty * np.eye(slacks)
        gradient = np.full(wide + slacks, problem.penalty)
        gradient[:wide] = slope.T @ (y - rates).ravel() + problem.change**2 * (
            self._shift.T @ before
        )
        gradient[:wide] += problem.collective**2 * (self._mean.T @ (self._mean @ flat - collective))
        room = np.maximum(problem.limit - self.kappa * sigma, TIGHTEST * problem.limit).ravel()
        slack = np.eye(slacks)
        rows = np.vstack([np.hstack([slope, -slack]), np.hstack([-slope, -slack])])
        upper = np.concatenate([room - y.ravel(), room + y.ravel()])
        found = self._solve(
            h=hessian,
            g=gradient,
            a=rows,
            lba=-np.inf,
            uba=upper,
            lbx=np.concatenate([problem.u_min - flat, np.zeros(slacks)]),
            ubx=np.concatenate([problem.u_max - flat, np.full(slacks, np.inf)]),
        )
        change = found["x"].full().ravel()[:wide]
        solved = bool(self._solve.stats()["success"]) and bool(np.isfinite(change).all())
        return (change if solved else np.zeros(wide)), solved


def _stages(f: ModelFunctions, horizon: int, gain: FloatArray) -> ca.Function:
    """(x, U (n_u, N), p) -> y (n_y, N), its variance, and A, B, C, D of all stages side by side."""
    sizes = f.sizes
    n_d, n_g = sizes["n_d"], sizes["n_g"]
    x, plan, p = (
        ca.MX.sym("x", sizes["n_x"]),
        ca.MX.sym("U", sizes["n_u"], horizon),
        ca.MX.sym("p", sizes["n_p"]),
    )
    now, spread, common = x, ca.MX(n_d, n_d), ca.MX(n_d, n_g)
    found: list[list[ca.MX]] = [[] for _ in range(6)]
    for k in range(horizon):
        u = plan[:, k]
        after, a, b, _ = f["f_d_jac"](now, u, p)
        y, c, d, _ = f["h_jac"](now, u, p)
        known: Mapping[str, ca.MX] = {"x": now, "u": u, "p": p, "S": spread} | (
            {"c": common} if n_g else {}
        )
        seen = f["output_consider" if n_g else "output_covariance"].call(known)["Y"]
        # C and D belong to y - y_hat as the filter forms it, for plain outputs the slope of y
        # itself.
        for values, value in zip(found, (y, ca.diag(seen), a, b, c, d), strict=True):
            values.append(value)
        step = f["consider_step"].call(dict(known) | {"K": ca.DM(gain)})
        now, spread, common = after, step["S_next"], step.get("c_next", common)
    results = [ca.densify(ca.horzcat(*values)) for values in found]
    return ca.Function("rate_stages", [x, plan, p], results)
