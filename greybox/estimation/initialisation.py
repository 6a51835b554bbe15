"""Where a fit starts: noise levels from the autocovariance of first innovations, parameters by equation error, multistart.

Each function takes a `Problem` and gives a start vector (n,) in the order of its unknowns; they can follow each other:

    theta = equation_error(problem);  theta = noise_start(problem, theta);  theta, status = solver.solve(problem, theta)
"""

from __future__ import annotations

import concurrent.futures
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.optimize

from greybox.errors import DataError, FitError
from greybox.estimation.engine import GainTable
from greybox.estimation.gain import Linearisation, Riccati, stationary
from greybox.estimation.predictors.innovation import Innovation
from greybox.estimation.predictors.simulation import start_of
from greybox.estimation.problem import Problem
from greybox.estimation.record import Record
from greybox.estimation.solvers.levenberg_marquardt import damped_step
from greybox.estimation.status import Code, Status
from greybox.symbolic import FloatArray


def _reference(problem: Problem) -> dict[str, Any]:
    """Linearisation, reference point and pseudo-sensor of the problem, made where its predictor has none."""
    if "linearisation" not in problem.state:
        problem.state.update(Innovation().prepare(problem))
    return problem.state


def _filter(
    problem: Problem, theta: FloatArray, process: FloatArray, sensor: FloatArray
) -> tuple[Riccati, tuple[FloatArray, ...]]:
    """Stationary filter at given noise levels, and (A, G, C, D) at the reference."""
    state = _reference(problem)
    lin: Linearisation = state["linearisation"]
    x, window = state["reference"]
    values = lin.values(x, window, problem.parameters_of(theta, None), problem.dt)
    return stationary(values, process**2, sensor**2, state["weak"]), values


def _pass(
    problem: Problem, theta: FloatArray, riccati: Riccati, i: int, jacobian: bool
) -> tuple[Record, FloatArray, FloatArray | None]:
    """(record, innovations, their sensitivity to the active parameters) with the filter's gain held."""
    record, engine = problem.records[i], problem.engine
    x0, s0, _ = start_of(problem, theta, i)
    s0 = np.ascontiguousarray(s0[:, : len(engine.active)])
    gains = GainTable(
        gain=np.array([riccati.gain(m)[0] for m in record.patterns]),
        zero=np.array([not m.any() for m in record.patterns], dtype=np.int32),
    )
    run = engine.run(
        x0=x0, inputs=record.inputs, outputs=record.outputs, mask=record.mask, pattern=record.pattern, gains=gains,
        p=problem.parameters_of(theta, record.flight), dt=record.dt, s0=s0 if jacobian else None,
        want=frozenset({"innovations", "sensitivity"}),
    )  # fmt: skip
    if run.failed_at is not None:
        raise FitError(f"the prediction of flight {record.flight} is not finite after sample {run.failed_at}")
    assert run.innovations is not None
    return record, run.innovations, run.sensitivity


# ---------------------------------------------------------------------------------------------------- noise levels


def noise_start(
    problem: Problem, theta: FloatArray | None = None, *, lags: int = 15, rounds: int = 2, skip_seconds: float = 0.5
) -> FloatArray:
    """Start vector whose noise levels explain the autocovariance of the innovations at `theta` (default: the start).

    Autocovariance least squares: under a fixed gain the autocovariances of the innovations up to `lags` are linear in
    the variances of process and sensor noise, which follow by non-negative least squares (Odelson, Rajamani and
    Rawlings 2006, Automatica 42(2), eq. 13-19). `rounds` repeats it with the gain just found; the first `skip_seconds`
    of each record are left out. What the model misses counts as process noise, as a predictor wants it. Levels stay
    within a factor 1000 of where they were. Returns the start unchanged where noise levels are no unknowns.
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
        for place, value in zip(places, level):
            if place is not None:
                theta[place] = np.log(value)
        theta = np.clip(theta, problem.lower, problem.upper)
    return theta


def _autocovariance(
    problem: Problem, theta: FloatArray, riccati: Riccati, lags: int, skip_seconds: float
) -> FloatArray:
    """Sample autocovariance (lags + 1, n_e, n_e), mean of e(t + l) e(t)' over the samples that have both."""
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
    values: tuple[FloatArray, ...], riccati: Riccati, process: FloatArray, sensor: FloatArray, lags: int
) -> FloatArray:
    """Autocovariances (n_w + n_e, lags + 1, n_e, n_e) that each noise source at its present level adds."""
    a, g, c, d = values
    k, _, _, _ = riccati.gain(np.ones(c.shape[0]))
    closed = a - k @ c
    sources = [
        np.column_stack([(g - k @ d)[:, j], d_]) if False else ((g - k @ d)[:, j], d_) for j, d_ in enumerate(d.T)
    ]
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
    """Non-negative factors on the variances, channels scaled to unit innovation variance; NaN cells are left out."""
    size = np.sqrt(np.maximum(np.nan_to_num(np.diagonal(seen[0])), 1e-300))
    weight = 1.0 / np.outer(size, size)
    y = (seen * weight).ravel()
    x = (responses * weight).reshape(len(responses), -1).T
    good = np.isfinite(y)
    reach = np.maximum(np.abs(x[good]).max(axis=0, initial=0.0), 1e-300)
    factors, _ = scipy.optimize.nnls(x[good] / reach, y[good], maxiter=50 * len(responses))
    return factors / reach
