"""Multiple shooting: the residuals, the cost and the optimum of pure simulation, reached on a path
that may first be broken.

Every record is cut in windows with a start state of their own, which must meet the end of the
window before:

    min over theta, s_0 .. s_m of V(e(s, theta))   subject to   c_k = F_k(s_k, theta) boxminus s_(k+1) = 0

The generalised Gauss-Newton method linearises residuals and continuity alike, and condensing
removes s_1 .. s_m from each step (Bock 1987, Randwertproblemmethoden zur Parameteridentifizierung,
Bonner Math. Schriften 183; Bock, Kostina and Schloder 2007, GAMM-Mitteilungen 30(2)):

    v_(k+1) = A_k v_k + c_k,   D_(k+1) = A_k D_k + B_k;   residuals e_k + E_k v_k,   Jacobian H_k + E_k D_k

Start states come from a filter that follows the measurements, so that a poor theta cannot make the
path run away. When the gaps have closed the problem *is* simulation, and any solver ends the work
there. For windows without continuity, cut the data set into short flights and fit `Simulation`:
that is another estimator, with another optimum.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, final

import casadi as ca
import numpy as np

from greybox.errors import FitError, ModelError
from greybox.estimation.criteria.gaussian import Gaussian
from greybox.estimation.gain import stationary
from greybox.estimation.predictor import Block, Predictor
from greybox.estimation.predictors.innovation import Innovation, InnovationPrepared
from greybox.estimation.predictors.simulation import Simulation, start_of
from greybox.estimation.prior import prior_terms
from greybox.estimation.recursion import GainTable
from greybox.estimation.solver import IndexArray, Progress
from greybox.estimation.solvers.levenberg_marquardt import damped_step
from greybox.symbolic import CASADI, FloatArray

if TYPE_CHECKING:
    from greybox.estimation.problem import Problem


@dataclass(frozen=True, kw_only=True, eq=False)
class ShootingPrepared:
    """The chart's `difference` (CasADi: states a, b -> boxminus(a, b)) and what the `filter` of the
    start states needs."""

    difference: ca.Function
    filter: InnovationPrepared


@final
@dataclass(frozen=True, kw_only=True)
class MultipleShooting(Predictor[ShootingPrepared]):
    """Simulation with windows of `window_s` seconds on the way; `approach` closes the gaps from any
    start."""

    window_s: float = 0.5
    max_iterations: int = 25
    halvings: int = 3
    gap_tolerance: float = 1e-3
    name: str = "multiple-shooting"
    simulation: Simulation = field(default_factory=Simulation)

    def __post_init__(self) -> None:
        if not self.window_s > 0:
            raise ModelError(
                "the window of multiple shooting must be positive", got=f"{self.window_s:g} s"
            )

    def prepare(self, problem: Problem) -> ShootingPrepared:
        """The chart's difference and what the filter of the start states needs."""
        n = len(problem.dynamics.states)
        a, b = ca.SX.sym("a", n), ca.SX.sym("b", n)
        difference = ca.Function("difference", [a, b], [problem.dynamics.boxminus(a, b)])
        return ShootingPrepared(difference=difference, filter=problem.prepared(Innovation()))

    def blocks(self, problem: Problem, theta: FloatArray, jacobian: bool) -> Iterable[Block]:
        """Simulation errors of every record: those of the unbroken path."""
        return self.simulation.blocks(problem, theta, jacobian)

    def approach(
        self, problem: Problem, start: FloatArray, progress: Progress | None = None
    ) -> FloatArray:
        """Unknowns (n,) from which simulation goes on: Bock's iteration until the gaps have closed.

        Full steps, which contract fast where they contract at all; where they do not, the windows
        are halved and the iteration starts again, up to `halvings` times. Gaps count in units of
        the prior of the initial state. Returns `start` where nothing was found that simulates
        better.
        """
        first = problem.evaluate(start, 0)
        for halving in range(self.halvings + 1):
            try:
                theta = self._close(problem, start, self.window_s / 2**halving, progress)
            except FitError:
                continue
            last = problem.evaluate(theta, 0)
            if last.valid and not (first.valid and first.cost < last.cost):
                return theta
        return np.array(start)

    def _close(
        self, problem: Problem, start: FloatArray, window_s: float, progress: Progress | None
    ) -> FloatArray:
        """Iterate with windows of this length. Raises `FitError` where the gaps do not close."""
        lower, upper = problem.lower, problem.upper
        theta = problem.inside(start)
        prepared = problem.prepared(self)
        path = _path(problem, prepared.filter, theta, window_s)
        for iteration in range(1, self.max_iterations + 1):
            parts = [_part(problem, prepared.difference, theta, i, w) for i, w in enumerate(path)]
            value = Gaussian().evaluate(problem, [p.block for p in parts], 1, None)
            cost, slope, curvature = prior_terms(problem.unknowns, theta)
            assert value.gradient is not None and value.hessian is not None
            gradient, hessian = value.gradient + slope, value.hessian + np.diag(curvature)
            if not (
                np.isfinite(value.cost)
                and np.isfinite(gradient).all()
                and np.isfinite(hessian).all()
            ):
                break
            held = ((theta <= lower) & (gradient > 0)) | ((theta >= upper) & (gradient < 0))
            new = problem.inside(theta + damped_step(gradient, hessian, held, 0.0))
            step = new - theta
            decrement = max(-float(gradient @ step + 0.5 * step @ hessian @ step), 0.0)
            if progress:
                progress(iteration, value.cost + cost, decrement)
            gap = max((float(np.abs(p.gaps).max(initial=0.0)) for p in parts), default=0.0)
            if gap < self.gap_tolerance and decrement < 1.0:
                return new
            if not step.any():
                break
            path = [_moved(problem, w, p, step) for w, p in zip(path, parts)]
            theta = new
        raise FitError("the gaps of multiple shooting did not close", fix="shorter windows")


@dataclass(frozen=True, kw_only=True, eq=False)
class _Windows:
    """One record: rows (m,) and lengths (m,) of its windows, and their start states (m, n_x)."""

    rows: IndexArray
    lengths: IndexArray
    starts: FloatArray


@dataclass(frozen=True, kw_only=True, eq=False)
class _Part:
    """One record at the broken path: condensed residuals, and the moves of the start states."""

    block: Block
    shift: FloatArray  # v_k, (m, n_d)
    slope: FloatArray  # D_k, (m, n_d, n_s)
    gaps: FloatArray  # c_k / sigma, (m - 1, n_d)


def _path(
    problem: Problem, prepared: InnovationPrepared, theta: FloatArray, window_s: float
) -> list[_Windows]:
    """Start states along every record from a stationary filter with lively process noise."""
    process, sensor = problem.noise_levels(theta)
    p = problem.parameters_of(theta, None)
    values = prepared.linearisation.values(*prepared.reference, p, problem.dt)
    riccati = stationary(values, (10.0 * process) ** 2, sensor**2, prepared.weak)
    out = []
    for i, record in enumerate(problem.records):
        size = max(2, round(window_s / record.dt))
        rows = np.arange(0, max(record.n - size // 2, 1), size)
        x0, _, _ = start_of(problem, theta, i)
        gains = GainTable(
            gain=np.array([riccati.gain(m)[0] for m in record.patterns]),
            zero=np.array([not m.any() for m in record.patterns], dtype=np.int32),
        )
        run = problem.engine.run(
            x0=x0,
            pattern=record.pattern,
            gains=gains,
            p=problem.parameters_of(theta, record.flight),
            want=frozenset({"states"}),
            **record.samples,
        )
        if run.failed_at is not None or run.states is None:
            raise FitError(f"no path along flight {record.flight}")
        lengths = np.diff(np.append(rows, record.n))
        out.append(_Windows(rows=rows, lengths=lengths, starts=run.states[rows]))
    return out


def _part(
    problem: Problem, difference: ca.Function, theta: FloatArray, i: int, windows: _Windows
) -> _Part:
    record, engine = problem.records[i], problem.engine
    x0, s0, columns = start_of(problem, theta, i)
    m, nd, na = windows.rows.size, engine.nd, len(engine.active)
    own = np.zeros((m, nd, na + nd))
    own[:, :, na:] = np.eye(nd)
    run = engine.windows(
        starts=np.concatenate([x0[None], windows.starts[1:]]),
        rows=windows.rows,
        lengths=windows.lengths,
        tails=windows.lengths,
        p=problem.parameters_of(theta, record.flight),
        s0=own,
        **record.samples,
    )
    if run.failed_in is not None:
        raise FitError(f"window {run.failed_in} of flight {record.flight} is not finite")
    assert run.sensitivity is not None and run.end_sensitivity is not None
    gaps = np.zeros((m - 1, nd))
    if m > 1:
        with CASADI:
            gaps = np.asarray(difference(run.ends[:-1].T, windows.starts[1:].T).full()).T
    shift, slope = np.zeros((m, nd)), np.zeros((m, nd, s0.shape[1]))
    slope[0] = s0
    for k in range(m - 1):
        a, b = run.end_sensitivity[k][:, na:], run.end_sensitivity[k][:, :na]
        shift[k + 1] = a @ shift[k] + gaps[k]
        slope[k + 1] = a @ slope[k]
        slope[k + 1][:, :na] += b
    which = np.repeat(np.arange(m), windows.lengths)
    through = run.sensitivity[:, :, na:]
    jacobian = np.einsum("nij,njs->nis", through, slope[which], optimize=True)
    jacobian[:, :, :na] += run.sensitivity[:, :, :na]
    e = run.innovations + np.einsum("nij,nj->ni", through, shift[which])

    if not (np.isfinite(e).all() and np.isfinite(shift).all()):
        raise FitError(f"the gaps of flight {record.flight} run away")
    block = Block(
        record=record,
        e=e,
        mask=record.mask,
        jacobian=jacobian,
        columns=columns,
        covariance=None,
        covariance_slope=None,
        pattern=record.pattern,
    )
    return _Part(block=block, shift=shift, slope=slope, gaps=gaps / problem.start_sigma(i))


def _moved(problem: Problem, windows: _Windows, part: _Part, step: FloatArray) -> _Windows:
    """Start states after the step; the first one follows theta by itself."""
    move = part.shift + part.slope @ step[part.block.columns]
    starts = windows.starts.copy()
    for k in range(1, len(starts)):
        starts[k] = problem.engine.moved(windows.starts[k], move[k])[0]
    return _Windows(rows=windows.rows, lengths=windows.lengths, starts=starts)
