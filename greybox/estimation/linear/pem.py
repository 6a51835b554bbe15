"""Prediction error method for linear models: Gauss-Newton with Levenberg-Marquardt damping on exact sensitivities.

Criterion: N log det( 1/N sum e e' ), the Gaussian likelihood with Lambda concentrated out (Ljung 1999, section 7.4 and
equation 15.2b). The initial state and the output offset of every record are nuisance parameters that are eliminated
block by block. A step that leaves the region of stable predictors is refused, so that A - KC is stable by construction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

import numpy as np
import scipy.linalg as sla

from greybox.errors import FitError
from greybox.estimation.linear.parametrisation import Parametrisation
from greybox.estimation.linear.predictor import (
    Modes,
    Prediction,
    modal_mix,
    modal_signals,
    predict,
    sensitivities,
    start_sensitivities,
)
from greybox.estimation.linear.records import Record
from greybox.model.matrices import Matrices, spectral_radius
from greybox.symbolic import FloatArray

FLAT_GAIN = 0.05
"""Gain of three steps, in -2 log likelihood, below which the iteration ends as `Status.FLAT`."""


class Status(Enum):
    """How the iteration ended; the value is advice."""

    CONVERGED = "converged: a further Gauss-Newton step would change -2 log likelihood by less than the tolerance"
    FLAT = (
        "converged in likelihood: the last three steps together gained less than 0.05 of -2 log likelihood; the estimate "
        "moves along a direction that the data hardly determine: fewer states may do"
    )
    STALLED = (
        "not converged: no step improves the likelihood although the gradient is not zero; the model may sit at the "
        "stability limit or have more states than the data carry: lower the order"
    )
    MAX_ITERATIONS = "not converged: iteration limit reached; raise max_iterations or start from another method"
    NOT_RUN = "not polished: this is the subspace start"


@dataclass(frozen=True, kw_only=True)
class Nuisance:
    """Per record: initial state x0 (n,) and output offset (p,), in the scaled units of the fit."""

    x0: FloatArray
    offset: FloatArray


@dataclass(frozen=True, kw_only=True)
class Settings:
    """`tolerance` is in units of -2 log likelihood. `stable` demands |eig A| < 1; `offsets` frees one per record."""

    max_iterations: int = 100
    tolerance: float = 1e-3
    stable: bool = False
    offsets: bool = True
    free_start: bool = True
    radius: float = 1.0 - 1e-7


class Evaluation(NamedTuple):
    """Criterion at a point: -2 log likelihood (with constants), Lambda (p, p), predictions per record."""

    criterion: float
    noise: FloatArray
    predictions: list[Prediction]
    modes: Modes


@dataclass(frozen=True, kw_only=True)
class Solution:
    """Where the iteration ended. `information` (d, d) is J'J of whitened innovations along `tangent` (q, d)."""

    point: Parametrisation
    nuisances: tuple[Nuisance, ...]
    evaluation: Evaluation
    information: FloatArray
    tangent: FloatArray
    status: Status
    iterations: int
    decrement: float

    @property
    def system(self) -> Matrices:
        """The matrices at the solution, in scaled units."""
        return self.point.system


def evaluate(
    system: Matrices, nuisances: Sequence[Nuisance], records: Sequence[Record], noise: FloatArray
) -> Evaluation:
    """Innovations and criterion. `noise` is the Lambda used where samples miss; the returned one is re-estimated."""
    modes = Modes(system.predictor)
    holes = any(r.missing for r in records)
    p = len(system.c)
    for _ in range(2 if holes else 1):
        predictions = [predict(system, r, v.x0, v.offset, noise, modes) for r, v in zip(records, nuisances)]
        total, used = np.zeros((p, p)), 0
        for prediction, record in zip(predictions, records):
            e = prediction.e
            if prediction.gains is not None:
                settled = np.isfinite(record.y).all(axis=1) & (
                    np.abs(prediction.gains - system.k).max(axis=(1, 2)) < 1e-9
                )
                e = e[settled] if settled.sum() > 5 * p else e[np.isfinite(record.y).all(axis=1)]
            total += e.T @ e
            used += len(e)
        if not np.isfinite(total).all() or used <= p:
            return Evaluation(np.inf, noise, predictions, modes)
        noise = total / used
    sign, value = np.linalg.slogdet(noise)
    # A correlation matrix of determinant below exp(-30): an output is a combination of others, up to rounding.
    if sign <= 0 or not np.isfinite(value) or value - np.log(np.diag(noise)).sum() < -30.0:
        return Evaluation(np.inf, noise, predictions, modes)
    cost = 0.0
    for prediction, record in zip(predictions, records):
        seen = int(np.isfinite(record.y).sum()) if prediction.gains is not None else prediction.e.size
        cost += seen * np.log(2 * np.pi)
        if prediction.whitener is None:
            cost += len(record) * value
        else:
            cost += prediction.log_det + float((np.einsum("kij,kj->ki", prediction.whitener, prediction.e) ** 2).sum())
    # Over all records together e' Lambda^-1 e sums to p per sample; with holes only some of them are summed here.
    inverse = np.linalg.inv(noise)
    for q in predictions:
        if q.whitener is None:
            cost += p * len(q.e) if not holes else float(np.einsum("ki,ij,kj->", q.e, inverse, q.e, optimize=True))
    return Evaluation(float(cost), noise, predictions, modes)


class Normal(NamedTuple):
    """Normal equations with the nuisances eliminated, and what is needed to bring them back."""

    information: FloatArray
    gradient: FloatArray
    back: list[tuple[FloatArray, FloatArray]]


def normal_equations(
    point: Parametrisation, records: Sequence[Record], evaluation: Evaluation, settings: Settings
) -> Normal:
    """H = J'J and g = J'e of whitened innovations along the tangent; per record (N'N)^-1 [N'e, N'J] to go back."""
    tangent = point.tangent()
    d = tangent.shape[1]
    n, _, p = point.system.sizes
    whitener = np.linalg.inv(np.linalg.cholesky(evaluation.noise))
    h, g, back = np.zeros((d, d)), np.zeros(d), []
    fast = evaluation.modes.usable and np.linalg.cond(evaluation.modes.vectors) < 1e3
    mixing = _mixing(point.system, evaluation.modes, tangent, whitener) if fast else None
    for record, prediction in zip(records, evaluation.predictions):
        if mixing is not None and prediction.gains is None:
            hr, gr, cross, own, right = _by_gram(point.system, record, prediction, evaluation.modes, whitener, mixing)
        else:
            hr, gr, cross, own, right = _by_jacobian(
                point.system, record, prediction, evaluation.modes, whitener, tangent
            )
        keep = np.concatenate([np.full(n, settings.free_start), np.full(p, settings.offsets)])
        cross, own, right = cross[keep], own[np.ix_(keep, keep)], right[keep]
        if keep.any():
            inverse = np.linalg.pinv(own, rcond=1e-11, hermitian=True)
            hr = hr - cross.T @ inverse @ cross
            gr = gr - cross.T @ inverse @ right
            start, slope = np.zeros(n + p), np.zeros((n + p, d))
            start[keep], slope[keep] = inverse @ right, inverse @ cross
        else:
            start, slope = np.zeros(n + p), np.zeros((n + p, d))
        back.append((start, slope))
        h += hr
        g += gr
    return Normal((h + h.T) / 2, g, back)


def _mixing(system: Matrices, modes: Modes, tangent: FloatArray, whitener: FloatArray) -> FloatArray:
    """R (M, p, d): whitened sensitivities along the tangent = [modal signals, x, u] @ R."""
    n, m, p = system.sizes
    width, d = n + m + p, tangent.shape[1]
    mix = modal_mix(modes, whitener @ system.c)
    inner = tangent[: n * width].reshape(n, width * d)
    first = np.einsum("oar,ax->rox", mix, inner, optimize=True).reshape(mix.shape[2], p, width, d)
    first = first.transpose(0, 2, 1, 3).reshape(mix.shape[2] * width, p, d)
    tc = tangent[n * width : n * width + p * n].reshape(p, n, d)
    td = tangent[n * width + p * n :].reshape(p, m, d)
    second = np.einsum("ij,jkd->kid", whitener, np.concatenate([tc, td], axis=1))
    return np.concatenate([first, second], axis=0)


_Parts = tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]


def _by_gram(
    system: Matrices, record: Record, prediction: Prediction, modes: Modes, whitener: FloatArray, mixing: FloatArray
) -> _Parts:
    level = prediction.x @ system.c.T + record.u @ system.d.T + prediction.e
    count, p = prediction.e.shape
    basis = modal_signals(modes, np.hstack([prediction.x, record.u, level])).reshape(count, -1)
    basis = np.hstack([basis, prediction.x, record.u])
    e = prediction.e @ whitener.T
    jx, jc = start_sensitivities(system, modes, count)
    own = np.einsum("ij,kjn->ikn", whitener, np.concatenate([jx, jc], axis=2), optimize=True)
    gram = basis.T @ basis
    h = sum(mixing[:, o].T @ (gram @ mixing[:, o]) for o in range(p))
    g = sum(mixing[:, o].T @ (basis.T @ e[:, o]) for o in range(p))
    cross = sum((own[o].T @ basis) @ mixing[:, o] for o in range(p))
    block = sum(own[o].T @ own[o] for o in range(p))
    right = sum(own[o].T @ e[:, o] for o in range(p))
    return h, g, cross, block, right  # type: ignore[return-value]


def _by_jacobian(
    system: Matrices, record: Record, prediction: Prediction, modes: Modes, whitener: FloatArray, tangent: FloatArray
) -> _Parts:
    j, jx, jc = sensitivities(system, record, prediction, modes)
    whole = np.concatenate([j @ tangent, jx, jc], axis=2)
    if prediction.whitener is None:
        whole = np.einsum("ij,kjd->kid", whitener, whole, optimize=True)
        e = prediction.e @ whitener.T
    else:
        whole = np.einsum("kij,kjd->kid", prediction.whitener, whole, optimize=True)
        e = np.einsum("kij,kj->ki", prediction.whitener, prediction.e)
    d = tangent.shape[1]
    flat, e = whole.reshape(-1, whole.shape[2]), e.ravel()
    gram = flat.T @ flat
    right = flat.T @ e
    return gram[:d, :d], right[:d], gram[d:, :d], gram[d:, d:], right[d:]


def start_nuisances(system: Matrices, records: Sequence[Record], settings: Settings) -> tuple[Nuisance, ...]:
    """Least squares initial states and offsets for fixed matrices, scaled records assumed."""
    n, _, p = system.sizes
    out = []
    for r in records:
        zero = Nuisance(x0=np.zeros(n), offset=np.zeros(p))
        if not (settings.free_start or settings.offsets):
            out.append(zero)
            continue
        prediction = predict(system, r, zero.x0, zero.offset, np.eye(p))
        if prediction.gains is None and Modes(system.predictor).usable:
            jx, jc = start_sensitivities(system, Modes(system.predictor), len(r))
        else:
            _, jx, jc = sensitivities(system, r, prediction)
        keep = np.concatenate([np.full(n, settings.free_start), np.full(p, settings.offsets)])
        whole = np.concatenate([jx, jc], axis=2).reshape(-1, n + p)[:, keep]
        value = np.zeros(n + p)
        value[keep] = sla.lstsq(whole, prediction.e.ravel(), cond=1e-9)[0]
        out.append(Nuisance(x0=value[:n], offset=value[n:]))
    return tuple(out)


def minimise(
    point: Parametrisation,
    records: Sequence[Record],
    settings: Settings | None = None,
    *,
    nuisances: Sequence[Nuisance] | None = None,
) -> Solution:
    """Minimise the criterion from `point`; records scaled by `prepare`. Raises `FitError` for a useless start."""
    settings = settings or Settings()
    if not _allowed(point.system, settings):
        raise FitError("the start has an unstable predictor", fix="start from a subspace method")
    current = tuple(nuisances) if nuisances is not None else start_nuisances(point.system, records, settings)
    noise = np.eye(len(point.system.c))
    here = evaluate(point.system, current, records, noise)
    if not np.isfinite(here.criterion):
        raise FitError(
            "the criterion is not finite at the start: an output is predicted without error",
            fix="lower the order, or drop outputs that are combinations of others",
        )
    # With holes the sensitivities are those of a frozen gain: the last digits of the descent are not to be had.
    holes = any(r.missing for r in records)
    tries, near = (12, 0.1) if holes else (25, max(1e-3, 1e3 * settings.tolerance))
    tolerance = max(settings.tolerance, 1e-2) if holes else settings.tolerance
    damping, status, iteration, decrement = 1e-4, Status.MAX_ITERATIONS, 0, np.inf
    normal = normal_equations(point, records, here, settings)
    if not _finite(normal):
        raise FitError(
            "the sensitivities are not finite at the start", fix="start from another method or a lower order"
        )
    gains: list[float] = []
    while iteration < settings.max_iterations:
        iteration += 1
        decrement = _decrement(normal)
        if decrement < tolerance:
            status = Status.CONVERGED
            break
        accepted = False
        for _ in range(tries):
            step = _damped(normal, damping)
            trial = point.moved(step)
            if _allowed(trial.system, settings):
                moved = _moved(current, normal.back, step)
                there = evaluate(trial.system, moved, records, here.noise)
                if there.criterion < here.criterion:
                    following = normal_equations(trial, records, there, settings)
                    if _finite(following):
                        accepted = True
                        break
            damping = max(damping, 1e-6) * 8.0
        if not accepted:
            status = Status.CONVERGED if decrement < near else Status.STALLED
            break
        gains.append(here.criterion - there.criterion)
        point, current, here = trial, moved, there
        damping = max(damping / 10.0, 1e-12)
        normal = following
        if len(gains) >= 3 and sum(gains[-3:]) < FLAT_GAIN and _decrement(normal) >= tolerance:
            status, decrement = Status.FLAT, _decrement(normal)
            break
    return Solution(
        point=point,
        nuisances=current,
        evaluation=here,
        information=normal.information,
        tangent=point.tangent(),
        status=status,
        iterations=iteration,
        decrement=float(decrement),
    )


def _allowed(system: Matrices, settings: Settings) -> bool:
    if not all(np.isfinite(v).all() for v in system):
        return False
    if spectral_radius(system.predictor) >= settings.radius:
        return False
    return not settings.stable or spectral_radius(system.a) < settings.radius


def _finite(normal: Normal) -> bool:
    return bool(np.isfinite(normal.information).all() and np.isfinite(normal.gradient).all())


def _decrement(normal: Normal) -> float:
    """Predicted decrease of -2 log likelihood of a full step, over directions that the data see."""
    h, g = normal.information, normal.gradient
    if not len(g):
        return 0.0
    scale = np.sqrt(np.maximum(np.diag(h), 1e-14 * max(float(np.diag(h).max(initial=0.0)), 1e-300)))
    values, vectors = np.linalg.eigh(h / np.outer(scale, scale))
    keep = values > 1e-10 * values[-1]
    return float((((vectors.T @ (g / scale))[keep]) ** 2 / values[keep]).sum())


def _damped(normal: Normal, damping: float) -> FloatArray:
    h, g = normal.information, normal.gradient
    scale = np.sqrt(np.maximum(np.diag(h), 1e-14 * max(float(np.diag(h).max(initial=0.0)), 1e-300)))
    scaled = h / np.outer(scale, scale) + damping * np.eye(len(g))
    try:
        return np.asarray(sla.cho_solve(sla.cho_factor(scaled), g / scale)) / scale
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.pinv(scaled, rcond=1e-12, hermitian=True) @ (g / scale)) / scale


def _moved(
    nuisances: Sequence[Nuisance], back: Sequence[tuple[FloatArray, FloatArray]], step: FloatArray
) -> tuple[Nuisance, ...]:
    out = []
    for v, (start, slope) in zip(nuisances, back):
        change = start - slope @ step
        n = len(v.x0)
        out.append(Nuisance(x0=v.x0 + change[:n], offset=v.offset + change[n:]))
    return tuple(out)
