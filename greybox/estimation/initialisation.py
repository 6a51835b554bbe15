"""Where a fit starts: noise levels from the autocovariance of first innovations, parameters by
equation error.

Each function takes a `Problem` and gives a start vector (n,) in the order of its unknowns; they can
follow each other:

    theta = equation_error(problem);  theta = noise_start(problem, theta);  theta, status = solver.solve(problem, theta)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.optimize

from greybox.errors import DataError, FitError
from greybox.estimation.gain import Riccati, stationary
from greybox.estimation.predictors.innovation import Innovation
from greybox.estimation.predictors.simulation import start_of
from greybox.estimation.prior import prior_terms
from greybox.estimation.problem import IndexArray, Problem
from greybox.estimation.record import Record, hold_missing
from greybox.estimation.recursion import GainTable
from greybox.estimation.solvers.levenberg_marquardt import damped_step
from greybox.symbolic import FloatArray


def _filter(
    problem: Problem, theta: FloatArray, process: FloatArray, sensor: FloatArray
) -> tuple[Riccati, tuple[FloatArray, ...]]:
    """Stationary filter at given noise levels, and (A, G, C, D) at the reference."""
    prepared = problem.prepared(Innovation())
    x, window = prepared.reference
    p = problem.parameters_of(theta, None)
    values = prepared.linearisation.values(x, window, p, problem.dt)
    return stationary(values, process**2, sensor**2, prepared.weak), values


def _pass(
    problem: Problem, theta: FloatArray, riccati: Riccati, i: int, jacobian: bool
) -> tuple[Record, FloatArray, FloatArray | None]:
    """(record, innovations, their sensitivity to the active parameters) with the filter's gain
    held."""
    record, engine = problem.records[i], problem.engine
    x0, s0, _ = start_of(problem, theta, i)
    s0 = np.ascontiguousarray(s0[:, : len(engine.active)])
    gains = GainTable(
        gain=np.array([riccati.gain(m)[0] for m in record.patterns]),
        zero=np.array([not m.any() for m in record.patterns], dtype=np.int32),
    )
    run = engine.run(
        x0=x0,
        pattern=record.pattern,
        gains=gains,
        p=problem.parameters_of(theta, record.flight),
        s0=s0 if jacobian else None,
        want=frozenset({"innovations", "sensitivity"}),
        **record.samples,
    )
    run.demand_finite(f"the prediction of flight {record.flight}")
    assert run.innovations is not None
    return record, run.innovations, run.sensitivity


# ----------------------------------------------------------------------------------- noise levels


def noise_start(
    problem: Problem,
    theta: FloatArray | None = None,
    *,
    lags: int = 15,
    rounds: int = 2,
    skip_seconds: float = 0.5,
) -> FloatArray:
    """Start vector whose noise levels explain the autocovariance of the innovations at `theta`
    (default: the start).

    Autocovariance least squares: under a fixed gain the autocovariances of the innovations up to
    `lags` are linear in the variances of process and sensor noise, which follow by non-negative
    least squares (Odelson, Rajamani and Rawlings 2006, Automatica 42(2), eq. 13-19). `rounds`
    repeats it with the gain just found; the first `skip_seconds` of each record are left out. What
    the model misses counts as process noise, as a predictor wants it. Levels stay within a factor
    1000 of where they were. A round whose levels let the prediction run away (they are those of a
    linear filter) is not taken. Returns the start unchanged where noise levels are no unknowns.
    """
    theta = np.array(problem.start if theta is None else theta, dtype=np.float64)
    names = [f"noise.process.{n}" for n in problem.dynamics.noises.names]
    names += [f"noise.sensor.{n}" for n in problem.dynamics.innovations.names]
    places = [problem.place(n) for n in names]
    if all(p is None for p in places):
        return theta
    for _ in range(rounds):
        process, sensor = problem.noise_levels(theta)
        try:
            riccati, values = _filter(problem, theta, process, sensor)
            seen = _autocovariance(problem, theta, riccati, lags, skip_seconds)
        except (FitError, np.linalg.LinAlgError):
            return theta
        variance = _least_squares(seen, _responses(values, riccati, process, sensor, lags))
        old = np.concatenate([process, sensor])
        level = np.clip(np.sqrt(variance) * old, 1e-3 * old, 1e3 * old)
        # A level that comes out as zero is only small: keep a share of what it was.
        level = np.maximum(level, np.where(variance > 0, 0.0, 0.1 * old))
        told = theta.copy()
        for place, value in zip(places, level):
            if place is not None:
                told[place] = np.log(value)
        told = np.clip(told, problem.lower, problem.upper)
        if not problem.evaluate(told, 0).valid:
            return theta
        theta = told
    return theta


def _autocovariance(
    problem: Problem, theta: FloatArray, riccati: Riccati, lags: int, skip_seconds: float
) -> FloatArray:
    """Sample autocovariance (lags + 1, n_e, n_e), mean of e(t + l) e(t)' over the samples that have
    both."""
    ne = problem.engine.ne
    total, count = np.zeros((lags + 1, ne, ne)), np.zeros((lags + 1, ne, ne))
    for i in range(len(problem.records)):
        record, e, _ = _pass(problem, theta, riccati, i, jacobian=False)
        skip = min(round(skip_seconds / record.dt), record.n // 4)
        e, mask = e[skip:], record.mask[skip:]
        for lag in range(min(lags + 1, len(e))):
            stop = len(e) - lag
            total[lag] += e[lag:].T @ e[:stop]
            count[lag] += mask[lag:].T @ mask[:stop]
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _responses(
    values: tuple[FloatArray, ...],
    riccati: Riccati,
    process: FloatArray,
    sensor: FloatArray,
    lags: int,
) -> FloatArray:
    """Autocovariances (n_w + n_e, lags + 1, n_e, n_e) that each noise source at its present level
    adds."""
    a, g, c, d = values
    k, _, _, _ = riccati.gain(np.ones(c.shape[0]))
    closed = a - k @ c
    sources = [((g - k @ d)[:, j], d_) for j, d_ in enumerate(d.T)]
    sources += [(-k[:, j], np.eye(c.shape[0])[:, j]) for j in range(c.shape[0])]
    out = np.zeros((len(sources), lags + 1, c.shape[0], c.shape[0]))
    for s, ((b, through), level) in enumerate(zip(sources, np.concatenate([process, sensor]))):
        b, through = level * b, level * through
        p = _lyapunov(closed, np.outer(b, b))
        out[s, 0] = c @ p @ c.T + np.outer(through, through)
        move = closed @ p @ c.T + np.outer(b, through)
        for lag in range(1, lags + 1):
            out[s, lag] = c @ move
            move = closed @ move
    return out


def _lyapunov(a: FloatArray, m: FloatArray) -> FloatArray:
    """X = a X a' + m by squaring; modes that hardly decay are cut at about a million samples."""
    x = m
    for _ in range(20):
        step = a @ x @ a.T
        x = x + step
        if np.abs(step).max() <= 1e-12 * max(float(np.abs(x).max()), 1e-300):
            break
        a = a @ a
    return x


def _least_squares(seen: FloatArray, responses: FloatArray) -> FloatArray:
    """Non-negative factors on the variances, channels scaled to unit innovation variance; NaN cells
    are left out."""
    size = np.sqrt(np.maximum(np.nan_to_num(np.diagonal(seen[0])), 1e-300))
    weight = 1.0 / np.outer(size, size)
    y = (seen * weight).ravel()
    x = (responses * weight).reshape(len(responses), -1).T
    good = np.isfinite(y)
    reach = np.maximum(np.abs(x[good]).max(axis=0, initial=0.0), 1e-300)
    factors, _ = scipy.optimize.nnls(x[good] / reach, y[good], maxiter=50 * len(responses))
    return factors / reach


# --------------------------------------------------------------------------------- equation error


def equation_error(
    problem: Problem,
    *,
    theta: FloatArray | None = None,
    instruments: Sequence[str] | None = None,
    lags: int = 10,
    stride: int = 1,
    steps: int = 5,
    trust: float = 30.0,
) -> FloatArray:
    """Start vector whose model parameters fit the step from one (nearly) measured state to the
    next.

    The filter runs with process noise `trust` times its start level, so that its state follows the
    measurements, and with the gain held; up to `steps` Gauss-Newton steps on the model parameters
    alone, priors and bounds included, each halved while it does not lower the cost. (Klein and
    Morelli 2006, Aircraft System Identification, ch. 5.)

    Under feedback the regressors carry the noise of the equation and the estimates are biased. With
    `instruments` (columns of the log that noise does not reach, such as setpoints; with `lags`
    delayed copies, `stride` samples apart) the sensitivities are first projected on them: two-stage
    least squares (Soderstrom and Stoica 1983, Instrumental Variable Methods for System
    Identification, ch. 3; Gilson and Van den Hof 2005, Automatica 41(2)). Raises `UnknownNameError`
    for a column that is not there and `DataError` for instruments that never move.
    """
    theta = np.clip(
        np.array(problem.start if theta is None else theta, dtype=np.float64),
        problem.lower,
        problem.upper,
    )
    if not any(u.kind == "parameter" for u in problem.unknowns):
        return theta
    process, sensor = problem.noise_levels(theta)
    basis = None if instruments is None else _instruments(problem, instruments, lags, stride)
    for _ in range(steps):
        riccati, _ = _filter(problem, theta, trust * process, sensor)
        equations = _Equations(problem=problem, riccati=riccati, basis=basis)
        e, jacobian = equations.errors(theta, True)
        count = np.maximum(sum(r.mask.sum(axis=0) for r in problem.records), 1)
        variance = np.maximum((e * e).sum(axis=0) / count, 1e-300)
        cost, gradient, hessian = equations.cost(theta, e, variance, jacobian)
        at = equations.chosen
        x, lower, upper = theta[at], problem.lower[at], problem.upper[at]
        held = ((x <= lower) & (gradient > 0)) | ((x >= upper) & (gradient < 0))
        step = damped_step(gradient, hessian, held, 1e-9)
        for _ in range(12):
            new = theta.copy()
            new[at] = np.clip(x + step, lower, upper)
            try:
                value, _, _ = equations.cost(new, equations.errors(new, False)[0], variance, None)
            except FitError:
                value = np.inf
            if value < cost:
                break
            step = 0.5 * step
        else:
            break
        theta = new
        if cost - value < 0.5:
            break
    return theta


@dataclass(frozen=True, kw_only=True, eq=False)
class _Equations:
    """Errors of all records stacked, under one held gain; `basis` (N, n_z) is orthonormal or
    None."""

    problem: Problem
    riccati: Riccati
    basis: FloatArray | None

    @property
    def chosen(self) -> IndexArray:
        """Places of the model parameters among the unknowns, (n_c,)."""
        return np.flatnonzero([u.kind == "parameter" for u in self.problem.unknowns])

    def errors(self, theta: FloatArray, jacobian: bool) -> tuple[FloatArray, FloatArray | None]:
        """(e (N, n_e), d e/d model parameters (N, n_e, n_c) or None)."""
        rows, slopes = [], []
        for i in range(len(self.problem.records)):
            record, e, de = _pass(self.problem, theta, self.riccati, i, jacobian)
            rows.append(e)
            if de is not None:
                columns = np.searchsorted(self.chosen, self.problem.local_columns(record.flight))
                if np.array_equal(columns, np.arange(self.chosen.size)):
                    slopes.append(de)
                    continue
                wide = np.zeros((*e.shape, self.chosen.size))
                wide[:, :, columns] = de
                slopes.append(wide)
        return np.concatenate(rows), np.concatenate(slopes) if slopes else None

    def cost(
        self, theta: FloatArray, e: FloatArray, variance: FloatArray, jacobian: FloatArray | None
    ) -> tuple[float, FloatArray, FloatArray]:
        """Weighted squares of the errors (of their part that the instruments explain) and of the
        priors."""
        unknowns = [self.problem.unknowns[i] for i in self.chosen]
        cost, gradient, curvature = prior_terms(unknowns, theta[self.chosen])
        hessian = np.diag(curvature)
        for j, v in enumerate(variance):
            part = e[:, j] if self.basis is None else self.basis.T @ e[:, j]
            cost += 0.5 * float(part @ part) / v
            if jacobian is not None:
                slope = jacobian[:, j] if self.basis is None else self.basis.T @ jacobian[:, j]
                gradient = gradient + slope.T @ part / v
                hessian = hessian + slope.T @ slope / v
        return cost, gradient, hessian


def _instruments(problem: Problem, names: Sequence[str], lags: int, stride: int) -> FloatArray:
    """Orthonormal basis (N, n_z) of the instruments' delayed copies and a constant, all records
    stacked."""
    parts = []
    for record in problem.records:
        z, _ = hold_missing(np.column_stack([record.segment.column(n) for n in names]))
        copies = [np.ones((record.n, 1))]
        for lag in range(lags + 1):
            shift = lag * stride
            copies.append(
                np.concatenate([np.repeat(z[:1], min(shift, record.n), 0), z])[: record.n]
            )
        parts.append(np.concatenate(copies, axis=1))
    table = np.concatenate(parts)
    if not np.isfinite(table).all():
        raise DataError(f"instrument without values among {', '.join(names)}")
    table[:, 1:] -= table[:, 1:].mean(axis=0)
    size = np.linalg.norm(table, axis=0)
    if not (size[1:] > 1e-9 * np.sqrt(len(table))).any():
        raise DataError(
            f"instruments that never move: {', '.join(names)}", fix="name columns with excitation"
        )
    u, sigma, _ = np.linalg.svd(table / np.maximum(size, 1e-300), full_matrices=False)
    return u[:, sigma > 1e-8 * sigma[0]]
