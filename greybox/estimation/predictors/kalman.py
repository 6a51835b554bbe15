"""Time-varying extended Kalman filter: the linearisation and the covariance follow the flight,
sample by sample.

    S_k = C P C' + D Q D' + R,   K_k = (A P C' + G Q D') S_k^-1,   P+ = A P A' + G Q G' - K_k S_k K_k'

with A, C, G, D at the predicted state, P from the prior of the initial state, and rows of missing
channels left out: the likelihood of the initial state, of gaps and of slow channels is accounted
for exactly (to first order in the nonlinearity; exactly for a linear model). (Anderson and Moore
1979, Optimal Filtering, sec. 8.2; Jategaonkar 2015, Flight Vehicle System Identification, sec.
5.5.) The attitude part is a multiplicative filter without the reset's second-order term (Markley
2003, J. Guidance 26(2)).

Residuals are decorrelated innovations L^-1 e with S = L D L': their order is that of the channels,
their variances D. Derivatives are central differences of the compiled filter (one-sided of second
order at a bound), 2 n_s passes; they agree with the cost to about 1e-7. Refine a fit of the
stationary innovation form with it rather than start with it.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Iterable
from dataclasses import dataclass
from importlib import resources
from typing import TYPE_CHECKING, ClassVar, final

import casadi as ca
import numpy as np
import numpy.typing as npt

from greybox.errors import FitError
from greybox.estimation.build import LOOP_FLAGS, MODEL_FLAGS, opened
from greybox.estimation.predictor import Block, Predictor
from greybox.estimation.record import Record
from greybox.estimation.reference_point import chart_jacobians, symbols
from greybox.estimation.settling import start_variances
from greybox.model.dynamics import Dynamics
from greybox.symbolic import FloatArray

if TYPE_CHECKING:
    from greybox.estimation.problem import Problem


@final
@dataclass(frozen=True, kw_only=True)
class Kalman(Predictor["Filter"]):
    """Extended Kalman filter with estimated noise levels; `step` is the difference in units of an
    unknown's scale.

    Initial states are no unknowns: their prior starts the filter.
    """

    name: str = "kalman"
    has_noise: ClassVar[bool] = True
    has_initial: ClassVar[bool] = False
    step: float = 1e-5

    def prepare(self, problem: Problem) -> Filter:
        """Generate and compile the filter of the model."""
        return filter_for(problem.dynamics, problem.engine.compiled)

    def blocks(self, problem: Problem, theta: FloatArray, jacobian: bool) -> Iterable[Block]:
        """Decorrelated innovations of every record and their variances."""
        noise = [f"noise.process.{n}" for n in problem.dynamics.noises.names]
        noise += [f"noise.sensor.{n}" for n in problem.dynamics.innovations.names]
        noise_columns = np.array(
            [p for p in map(problem.place, noise) if p is not None], dtype=np.intp
        )

        def work(i: int) -> Block:
            record = problem.records[i]
            columns = np.concatenate([problem.local_columns(record.flight), noise_columns])
            e, variance = self._pass(problem, theta, record)
            slopes = (
                [self._slope(problem, theta, record, int(c), e, variance) for c in columns]
                if jacobian
                else []
            )
            return Block(
                record=record,
                e=e,
                mask=record.mask,
                columns=columns,
                covariance=None,
                covariance_slope=None,
                pattern=record.pattern,
                jacobian=np.stack([s[0] for s in slopes], axis=-1) if slopes else None,
                variance=variance,
                variance_slope=np.stack([s[1] for s in slopes], axis=-1) if slopes else None,
            )

        return problem.map_records(work)

    def _pass(
        self, problem: Problem, theta: FloatArray, record: Record
    ) -> tuple[FloatArray, FloatArray]:
        process, sensor = problem.noise_levels(theta)
        return problem.prepared(self).run(
            record, problem.parameters_of(theta, record.flight), process**2, sensor**2
        )

    def _slope(
        self,
        problem: Problem,
        theta: FloatArray,
        record: Record,
        j: int,
        e: FloatArray,
        variance: FloatArray,
    ) -> tuple[FloatArray, FloatArray]:
        """Derivatives of innovations and variances with respect to unknown j."""
        u = problem.unknowns[j]
        h = self.step * u.scale

        def at(offset: float) -> tuple[FloatArray, FloatArray]:
            moved = theta.copy()
            moved[j] += offset
            return self._pass(problem, moved, record)

        if theta[j] - h >= u.lower and theta[j] + h <= u.upper:
            (e1, v1), (e2, v2) = at(h), at(-h)
            return (e1 - e2) / (2 * h), (v1 - v2) / (2 * h)
        h = h if theta[j] - h < u.lower else -h
        (e1, v1), (e2, v2) = at(h), at(2 * h)
        return (4 * e1 - e2 - 3 * e) / (2 * h), (4 * v1 - v2 - 3 * variance) / (2 * h)


class Filter:
    """Extended Kalman filter of one model, compiled to C or in CasADi's VM."""

    def __init__(self, dynamics: Dynamics, use_compiler: bool) -> None:
        self.dynamics = dynamics
        s = symbols(dynamics)
        x, u, y, p, w, dt = s["x"], s["U"], s["y"], s["p"], s["w"], s["dt"]
        after = dynamics.step(0, x, u, p, w, dt)
        e = dynamics.innovation(y, dynamics.output(0, x, u, p, w, dt), x)
        into, out = chart_jacobians(dynamics, x, after)
        parts = [
            after,
            e,
            out @ ca.jacobian(after, x) @ into,
            ca.jacobian(e, x) @ into,
            out @ ca.jacobian(after, w),
            ca.jacobian(e, w),
        ]
        quiet = ca.DM.zeros(len(dynamics.noises))
        parts = [ca.densify(ca.substitute(v, w, quiet)) for v in parts]
        self.lin = ca.Function("gb_ekf_lin", [x, u, y, p, dt], parts)
        z, k = ca.SX.sym("xF", len(dynamics.states)), ca.SX.sym("k", len(dynamics.error_states))
        self.move = ca.Function("gb_ekf_move", [z, k], [ca.densify(dynamics.boxplus(z, k))])
        self._library: ctypes.CDLL | None = None
        if use_compiler:
            generator = ca.CodeGenerator("gb_ekf_model.c", {"with_header": False})
            generator.add(self.lin)
            generator.add(self.move)
            driver = (
                resources.files("greybox.estimation").joinpath("ekf.c").read_text(encoding="utf-8")
            )
            self._library = opened(
                [
                    ("gb_ekf_model.c", generator.dump(), MODEL_FLAGS),
                    ("gb_ekf.c", driver, LOOP_FLAGS),
                ]
            )
        if self._library is not None:
            self._library.gb_ekf_buffer.restype = ctypes.c_longlong
            sizes = [ctypes.c_longlong() for _ in range(4)]
            self._library.gb_ekf_sizes(*(ctypes.byref(v) for v in sizes))
            self._work = [v.value for v in sizes]

    def run(
        self, record: Record, p: FloatArray, q: FloatArray, r: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """(L^-1 e, variances), both (n, n_e), for the noise variances q (n_w) and r (n_e). Raises
        `FitError`."""
        d = self.dynamics
        y = np.ascontiguousarray(np.where(np.isfinite(record.outputs), record.outputs, 0.0))
        x, first = np.array(record.x0, dtype=np.float64), record.inputs[: sum(d.window) + 1].T
        _, _, a, _, g, _ = (v.full() for v in self.lin(x, first, y[0], p, record.dt))
        spread = np.diag(start_variances(record, (a, g), q))
        e, variance = np.zeros_like(record.mask), np.ones_like(record.mask)
        call = self._run_vm if self._library is None else self._run_c
        bad = call(
            record,
            x,
            np.ascontiguousarray(spread),
            y,
            np.ascontiguousarray(p, dtype=np.float64),
            q,
            r,
            e,
            variance,
        )
        if bad:
            raise FitError(
                f"the Kalman filter of {d.name} breaks down at sample {bad - 1} of flight "
                f"{record.flight}"
            )
        return e, variance

    def _run_c(
        self,
        record: Record,
        x: FloatArray,
        spread: FloatArray,
        y: FloatArray,
        p: FloatArray,
        q: FloatArray,
        r: FloatArray,
        e: FloatArray,
        variance: FloatArray,
    ) -> int:
        d = self.dynamics
        nx, nd, ne, nw = len(d.states), len(d.error_states), len(d.innovations), len(d.noises)
        a, b, i, w = self._work
        assert self._library is not None
        buffer = np.zeros(int(self._library.gb_ekf_buffer(nx, nd, ne, nw)))
        q, r = np.ascontiguousarray(q), np.ascontiguousarray(r)
        return int(
            self._library.gb_ekf(
                record.n,
                nx,
                nd,
                ne,
                len(d.outputs),
                len(d.inputs),
                nw,
                _ptr(x),
                _ptr(spread),
                _ptr(record.inputs),
                _ptr(y),
                _ptr(record.mask),
                _ptr(p),
                ctypes.c_double(record.dt),
                _ptr(q),
                _ptr(r),
                _ptr(e),
                _ptr(variance),
                (ctypes.c_void_p * a)(),
                (ctypes.c_void_p * b)(),
                (ctypes.c_longlong * i)(),
                (ctypes.c_double * w)(),
                _ptr(buffer),
            )
        )

    def _run_vm(
        self,
        record: Record,
        x: FloatArray,
        spread: FloatArray,
        y: FloatArray,
        p: FloatArray,
        q: FloatArray,
        r: FloatArray,
        e: FloatArray,
        variance: FloatArray,
    ) -> int:
        width = sum(self.dynamics.window) + 1
        for t in range(record.n):
            there = record.mask[t] != 0
            parts = [
                v.full() for v in self.lin(x, record.inputs[t : t + width].T, y[t], p, record.dt)
            ]
            after, innovation, a, c, g, d = parts
            innovation, c, d = innovation.ravel() * there, -c * there[:, None], -d * there[:, None]
            s = c @ spread @ c.T + (d * q) @ d.T + np.diag(np.where(there, r, 1.0))
            n = a @ spread @ c.T + (g * q) @ d.T
            if not np.isfinite(s).all() or np.linalg.eigvalsh(s)[0] <= 0:
                return 1 + t
            root = np.linalg.cholesky(s)
            unit = root / np.diag(root)
            variance[t] = np.diag(root) ** 2
            e[t] = np.linalg.solve(unit, innovation)
            gain = np.linalg.solve(s, n.T).T
            spread = a @ spread @ a.T + (g * q) @ g.T - gain @ n.T
            spread = 0.5 * (spread + spread.T)
            x = np.asarray(self.move(after, gain @ innovation).full()).ravel()
            if not np.isfinite(x).all():
                return 1 + t
        return 0


def _ptr(array: npt.NDArray[np.generic]) -> ctypes.c_void_p:
    return array.ctypes.data_as(ctypes.c_void_p)


@functools.lru_cache(maxsize=8)
def _cached(dynamics: Dynamics, use_compiler: bool) -> Filter:
    return Filter(dynamics, use_compiler)


def filter_for(dynamics: Dynamics, use_compiler: bool) -> Filter:
    """The filter of a model, built once per process."""
    try:
        return _cached(dynamics, use_compiler)  # type: ignore[arg-type]
    except TypeError:  # a model that cannot be hashed
        return Filter(dynamics, use_compiler)
