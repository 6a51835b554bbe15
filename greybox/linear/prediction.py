"""Using a linear model: simulation, k-step prediction, Kalman filtering with missing samples,
adaptation to a record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from greybox.errors import DataError
from greybox.linear.pem import Settings, start_nuisances
from greybox.linear.predictor import predict, states
from greybox.linear.records import Record, delayed
from greybox.model.linear import LinearModel
from greybox.symbolic import FloatArray


@dataclass(frozen=True, kw_only=True)
class Filtered:
    """Kalman filter over a record: predicted states (N, n), filtered states (N, n), innovations (N,
    p) with NaN where missing, innovation covariances (N, p, p), and log likelihood of what was
    measured.
    """

    predicted: FloatArray
    filtered: FloatArray
    innovations: FloatArray
    covariances: FloatArray
    log_likelihood: float


def kalman(
    model: LinearModel,
    record: Record,
    *,
    x0: FloatArray | None = None,
    p0: FloatArray | None = None,
) -> Filtered:
    """Kalman filter of the innovation form (process noise K e, measurement noise e) with start
    N(x0, p0).

    Defaults: x0 = 0, p0 = 0 (then, without holes, this is the stationary predictor). A missing
    component is left out of the update. The delayed inputs are taken within the record, whose first
    max(delays) samples are cut. Source: Anderson and Moore 1979, chapter 5, correlated noises.
    """
    a, b, c, d, k = model.matrices
    n, _, p = model.matrices.sizes
    lam = model.noise
    q, s = k @ lam @ k.T, k @ lam
    moved = _in_deviations(model, record)
    x = np.zeros(n) if x0 is None else np.asarray(x0, dtype=float)
    cov = np.zeros((n, n)) if p0 is None else np.asarray(p0, dtype=float)
    count = len(moved)
    predicted, filtered = np.zeros((count, n)), np.zeros((count, n))
    e, big = np.full((count, p), np.nan), np.zeros((count, p, p))
    total = 0.0
    for i in range(count):
        predicted[i] = x
        big[i] = c @ cov @ c.T + lam
        v = np.flatnonzero(np.isfinite(moved.y[i]))
        ahead = a @ x + b @ moved.u[i]
        spread = a @ cov @ a.T + q
        if v.size:
            e[i, v] = moved.y[i, v] - c[v] @ x - d[v] @ moved.u[i]
            inverse = np.linalg.inv(big[i][np.ix_(v, v)])
            x = x + cov @ c[v].T @ inverse @ e[i, v]
            cross = a @ cov @ c[v].T + s[:, v]
            ahead = ahead + cross @ inverse @ e[i, v]
            spread = spread - cross @ inverse @ cross.T
            _, value = np.linalg.slogdet(big[i][np.ix_(v, v)])
            total -= 0.5 * (v.size * np.log(2 * np.pi) + value + e[i, v] @ inverse @ e[i, v])
        filtered[i] = x
        x, cov = ahead, (spread + spread.T) / 2
    return Filtered(
        predicted=predicted,
        filtered=filtered,
        innovations=e,
        covariances=big,
        log_likelihood=float(total),
    )


def simulate(
    model: LinearModel, u: FloatArray, *, x0: FloatArray | None = None, e: FloatArray | None = None
) -> FloatArray:
    """Outputs (N, p) for commands u (N, m) from x0, with innovations e (N, p) (default 0).

    Before the first sample a delayed command is taken to be the first one.
    """
    u = np.asarray(u, dtype=float)
    held = np.column_stack(
        [np.concatenate([np.full(d, col[0]), col])[: len(col)] for d, col in zip(model.delays, u.T)]
    )
    deviation = (held if u.shape[1] else u) - model.input_offset
    a, b, c, d, k = model.matrices
    noise = np.zeros((len(u), len(c))) if e is None else np.asarray(e, dtype=float)
    start = np.zeros(len(a)) if x0 is None else np.asarray(x0, dtype=float)
    x = states(a, deviation @ b.T + noise @ k.T, start)
    return np.asarray(x @ c.T + deviation @ d.T + noise + model.output_offset)


@dataclass(frozen=True, kw_only=True)
class Ahead:
    """Predictions at horizon h: `predicted` and `measured` (N - h, p) of y[k + h] from data up to
    sample k."""

    horizon: int
    predicted: FloatArray
    measured: FloatArray


def k_step(
    model: LinearModel,
    record: Record,
    horizons: Sequence[int],
    *,
    x0: FloatArray | None = None,
    offset: FloatArray | None = None,
) -> list[Ahead]:
    """Open-loop prediction from every origin k: the state knows y up to k, the recorded commands
    drive k + 1 .. k + h.

    h = 1 is the one-step prediction. `offset` (p,) replaces the model's output offset (see
    `adapt`). Raises `DataError` for a horizon below 1 or a record that is shorter than the longest.
    """
    if not horizons or min(horizons) < 1:
        raise DataError(f"horizons {list(horizons)}", expected="whole numbers >= 1")
    moved = _in_deviations(model, record, offset)
    if len(moved) <= max(horizons) + 1:
        raise DataError(
            f"{len(moved)} samples are fewer than the horizon {max(horizons)}", where=record.name
        )
    a, b, c, d, _ = model.matrices
    start = np.zeros(len(a)) if x0 is None else np.asarray(x0, dtype=float)
    x = predict(model.matrices, moved, start, np.zeros(len(c)), model.noise).x[1:]
    shift = model.output_offset if offset is None else np.asarray(offset)
    out, u, y = [], moved.u, moved.y + shift
    for h in range(1, max(horizons) + 1):
        if h in horizons:
            inputs = u[h:]
            out.append(
                Ahead(
                    horizon=h,
                    predicted=x[: len(inputs)] @ c.T + inputs @ d.T + shift,
                    measured=y[h:],
                )
            )
        x = x[:-1] @ a.T + u[h : h + len(x) - 1] @ b.T
    return out


@dataclass(frozen=True, kw_only=True)
class Adapted:
    """Initial state (n,) and output offset (p,) of a record, estimated from its first `samples`
    samples."""

    x0: FloatArray
    offset: FloatArray
    samples: int


def adapt(model: LinearModel, record: Record, seconds: float) -> Adapted:
    """Least squares of the innovations of the first `seconds` over x0 and the output offset;
    everything else is kept.

    Zero seconds give x0 = 0 and the model's own offset. Raises `DataError` where the record is too
    short.
    """
    count = round(seconds / model.dt)
    n, p = model.order, len(model.outputs)
    if count == 0:
        return Adapted(x0=np.zeros(n), offset=model.output_offset, samples=0)
    moved = _in_deviations(model, record)
    if count < 2 * (n + p) or count > len(moved):
        raise DataError(
            f"{seconds:g} s are {count} samples of {len(moved)}",
            where=record.name,
            expected=f"at least {2 * (n + p)} samples to adapt on, and no more than the record has",
        )
    scale = np.sqrt(np.diag(model.noise))
    first = Record(u=moved.u[:count], y=moved.y[:count] / scale, name=record.name)
    unit = model.matrices.scaled(np.ones(moved.u.shape[1]), scale)
    found = start_nuisances(unit, [first], Settings())[0]
    return Adapted(x0=found.x0, offset=model.output_offset + found.offset * scale, samples=count)


def _in_deviations(model: LinearModel, record: Record, offset: FloatArray | None = None) -> Record:
    moved = delayed(record, model.delays)
    shift = model.output_offset if offset is None else np.asarray(offset)
    return Record(u=moved.u - model.input_offset, y=moved.y - shift, name=record.name)
