"""Prediction error method for linear models: damped Newton steps on the exact gradient and Hessian.

Criterion: N log det( 1/N sum e e' ), the Gaussian likelihood with Lambda concentrated out (Ljung
1999, section 7.4 and equation 15.2b). The initial state and the output offset of every record are
nuisance parameters that are eliminated block by block. A step that leaves the region of stable
predictors is refused, so that A - KC is stable by construction. The Hessian is exact for free
models on records without holes (`gram`), else that of Gauss-Newton.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

import numpy as np

from greybox.errors import FitError
from greybox.linear.gram import Gram, separable
from greybox.linear.parametrisation import Free, Parametrisation
from greybox.linear.predictor import (
    Modes,
    Prediction,
    predict,
    sensitivities,
    start_sensitivities,
)
from greybox.linear.records import Record
from greybox.model.matrices import Matrices, spectral_radius
from greybox.symbolic import FloatArray

FIRST_DAMPING = 1e-3
"""Of a Hessian scaled to unit information."""
FLAT_GAIN = 0.05
"""Gain of three steps together, in -2 log likelihood, below which the iteration ends as
`Status.FLAT` where a full step promises more; at most 5 times the tolerance. Much more would stop
on plateaus behind which states of real flights were found."""


FORGET = 3.0
"""Time constants of the slowest predictor mode that the longest record must hold; exp(-3) of the
start is then left."""
RESOLVED = 1e-9
"""Information about a direction of start and offset together, as a share of the largest, below which
it is not estimated. Beside a pole near one the two do the same, and their huge difference would
leave no digits of what depends on the matrices."""


class Status(Enum):
    """How the iteration ended; the value is advice."""

    CONVERGED = (
        "converged: a further step would change the estimate by less than a tenth of a "
        "standard error"
    )
    FLAT = (
        "not converged: the steps gain next to nothing although the likelihood is not at a "
        "maximum, because the data hardly determine some direction: record longer or excite more; "
        "a lower order is for states that exact_order keeps"
    )
    STALLED = (
        "not converged: no step improves the likelihood although the gradient is not zero; the "
        "model may sit at the "
        "stability limit or have more states than the data carry: lower the order"
    )
    MAX_ITERATIONS = (
        "not converged: iteration limit reached; raise max_iterations or start from another method"
    )
    NOT_RUN = "not polished: this is the subspace start"

    @property
    def converged(self) -> bool:
        """Whether the optimum was reached."""
        return self is Status.CONVERGED


@dataclass(frozen=True, kw_only=True)
class Nuisance:
    """Per record: initial state x0 (n,) and output offset (p,), in the scaled units of the fit."""

    x0: FloatArray
    offset: FloatArray


@dataclass(frozen=True, kw_only=True)
class Settings:
    """`stable` demands |eig A| < 1; `offsets` frees one per record. The iteration stops as
    converged where the Hessian has no negative curvature and a full step promises less than
    `tolerance` of -2 log likelihood. That decrease is the square of the step in standard errors,
    over all directions together: 0.01 is a tenth of a standard error.
    """

    max_iterations: int = 100
    tolerance: float = 1e-2
    stable: bool = False
    offsets: bool = True
    free_start: bool = True
    radius: float = 1.0 - 1e-7


class Evaluation(NamedTuple):
    """Criterion at a point: -2 log likelihood (with constants), Lambda (p, p), predictions per
    record."""

    criterion: float
    noise: FloatArray
    predictions: list[Prediction]
    modes: Modes


@dataclass(frozen=True, kw_only=True)
class Solution:
    """Where the iteration ended. `information` (d, d) is J'J of whitened innovations along
    `tangent` (q, d)."""

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
    """Innovations and criterion. `noise` is the Lambda used where samples miss; the returned one is
    re-estimated."""
    modes = Modes(system.predictor)
    holes = any(r.missing for r in records)
    p = len(system.c)
    for _ in range(2 if holes else 1):
        predictions = [
            predict(system, r, v.x0, v.offset, noise, modes) for r, v in zip(records, nuisances)
        ]
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
    # A correlation matrix of determinant below exp(-30): an output is a combination of others, up
    # to rounding.
    if sign <= 0 or not np.isfinite(value) or value - np.log(np.diag(noise)).sum() < -30.0:
        return Evaluation(np.inf, noise, predictions, modes)
    cost = 0.0
    for prediction, record in zip(predictions, records):
        seen = (
            int(np.isfinite(record.y).sum()) if prediction.gains is not None else prediction.e.size
        )
        cost += seen * np.log(2 * np.pi)
        if prediction.whitener is None:
            cost += len(record) * value
        else:
            cost += prediction.log_det + float(
                (np.einsum("kij,kj->ki", prediction.whitener, prediction.e) ** 2).sum()
            )
    # Over all records together e' Lambda^-1 e sums to p per sample; with holes only some of them
    # are summed here.
    inverse = np.linalg.inv(noise)
    for q in predictions:
        if q.whitener is None:
            cost += (
                p * len(q.e)
                if not holes
                else float(np.einsum("ki,ij,kj->", q.e, inverse, q.e, optimize=True))
            )
    return Evaluation(float(cost), noise, predictions, modes)


class Normal(NamedTuple):
    """Half the gradient and Hessian of the criterion with the nuisances eliminated, and what brings
    those back.

    `information` is J'J of whitened innovations, `hessian` the exact one where it is known, else
    the same.
    """

    information: FloatArray
    gradient: FloatArray
    hessian: FloatArray
    back: list[tuple[FloatArray, FloatArray]]


def normal_equations(
    point: Parametrisation, records: Sequence[Record], evaluation: Evaluation, settings: Settings
) -> Normal:
    """J'J, J'e and Hessian along the tangent; per record (N'N)^-1 [N'e, N'J] to go back. Exact for
    straight steps."""
    tangent = point.tangent()
    d = tangent.shape[1]
    n, _, p = point.system.sizes
    whitener = np.linalg.inv(np.linalg.cholesky(evaluation.noise))
    holes = any(q.gains is not None for q in evaluation.predictions)
    modal = (
        Gram(point.system, evaluation.modes, tangent, whitener)
        if separable(evaluation.modes)
        else None
    )
    exact = modal is not None and not holes and isinstance(point, Free)
    h, g, second, mixed = np.zeros((d, d)), np.zeros(d), np.zeros((d, d)), np.zeros((p, p, d))
    back = []
    keep = np.concatenate([np.full(n, settings.free_start), np.full(p, settings.offsets)])
    for record, prediction in zip(records, evaluation.predictions):
        if modal is not None and prediction.gains is None:
            parts = modal.parts(record, prediction)
            whole, right, products = parts.information, parts.gradient, parts.mixed
            second += parts.second
        else:
            whole, right = _by_jacobian(
                point.system, record, prediction, evaluation.modes, whitener, tangent
            )
            products = np.zeros((p, p, d + n + p))
        start, slope = np.zeros(n + p), np.zeros((n + p, d))
        cross = whole[d:, :d][keep]
        inverse = np.linalg.pinv(whole[d:, d:][np.ix_(keep, keep)], rcond=RESOLVED, hermitian=True)
        start[keep], slope[keep] = inverse @ right[d:][keep], inverse @ cross
        h += whole[:d, :d] - cross.T @ slope[keep]
        g += right[:d] - cross.T @ start[keep]
        mixed += products[:, :, :d] - (products[:, :, d:].reshape(p * p, n + p) @ slope).reshape(
            p, p, d
        )
        back.append((start, slope))
    h = (h + h.T) / 2
    if not exact:
        return Normal(h, g, h, back)
    turn = (mixed + mixed.transpose(1, 0, 2)).reshape(p * p, d)
    return Normal(h, g, h - second - turn.T @ turn / (2 * sum(len(r) for r in records)), back)


def _by_jacobian(
    system: Matrices,
    record: Record,
    prediction: Prediction,
    modes: Modes,
    whitener: FloatArray,
    tangent: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """J'J and J'e of one record, columns along the tangent, x0 and offset: the slow way, for holes
    and joined modes."""
    j, jx, jc = sensitivities(system, record, prediction, modes)
    whole = np.concatenate([j @ tangent, jx, jc], axis=2)
    if prediction.whitener is None:
        whole = np.einsum("ij,kjd->kid", whitener, whole, optimize=True)
        e = prediction.e @ whitener.T
    else:
        whole = np.einsum("kij,kjd->kid", prediction.whitener, whole, optimize=True)
        e = np.einsum("kij,kj->ki", prediction.whitener, prediction.e)
    flat = whole.reshape(-1, whole.shape[2])
    return flat.T @ flat, flat.T @ e.ravel()


def start_nuisances(
    system: Matrices,
    records: Sequence[Record],
    settings: Settings,
    noise: FloatArray | None = None,
) -> tuple[Nuisance, ...]:
    """Least squares initial states and offsets for fixed matrices, weighted by the innovation
    covariance `noise` (None: the identity, scaled records assumed)."""
    n, _, p = system.sizes
    modes = Modes(system.predictor)
    keep = np.concatenate([np.full(n, settings.free_start), np.full(p, settings.offsets)])
    whitener = np.eye(p) if noise is None else np.linalg.inv(np.linalg.cholesky(noise))
    out = []
    for r in records:
        zero = Nuisance(x0=np.zeros(n), offset=np.zeros(p))
        if not keep.any():
            out.append(zero)
            continue
        prediction = predict(system, r, zero.x0, zero.offset, np.eye(p), modes)
        if prediction.gains is None and modes.usable:
            jx, jc = start_sensitivities(system, modes, len(r))
        else:
            _, jx, jc = sensitivities(system, r, prediction)
        whole = np.matmul(whitener, np.concatenate([jx, jc], axis=2)[:, :, keep])
        whole = whole.reshape(-1, whole.shape[2])
        value = np.zeros(n + p)
        value[keep] = np.linalg.pinv(whole.T @ whole, rcond=RESOLVED, hermitian=True) @ (
            whole.T @ (prediction.e @ whitener.T).ravel()
        )
        out.append(Nuisance(x0=value[:n], offset=value[n:]))
    return tuple(out)


def minimise(
    point: Parametrisation,
    records: Sequence[Record],
    settings: Settings | None = None,
    *,
    nuisances: Sequence[Nuisance] | None = None,
) -> Solution:
    """Minimise the criterion from `point`; records scaled by `prepare`. Raises `FitError` for a
    useless start."""
    settings = settings or Settings()
    descent = _Descent(records, settings, _forgetful(settings, point, records))
    here = descent.begin(point, nuisances)
    # With holes the sensitivities are those of a frozen gain: the last digits of the descent are
    # not to be had.
    holes = any(r.missing for r in records)
    tries, near = (12, 0.1) if holes else (25, max(1e-3, 1e3 * settings.tolerance))
    tolerance = max(settings.tolerance, 1e-2) if holes else settings.tolerance
    damping, status, iteration, decrement = FIRST_DAMPING, Status.MAX_ITERATIONS, 0, np.inf
    gains: list[float] = []
    while True:
        model = _Quadratic.of(here.normal)
        decrement = model.decrement
        if decrement < tolerance and model.convex:
            status = Status.CONVERGED
            break
        # Where a step promises no more, the next few end the descent.
        flat = min(FLAT_GAIN, 5 * tolerance)
        if len(gains) >= 3 and sum(gains[-3:]) < flat < decrement:
            status = Status.FLAT
            break
        if iteration >= settings.max_iterations:
            break
        iteration += 1
        below = descent.below(here, model, damping, tries)
        if below is None:
            status = Status.CONVERGED if decrement < near else Status.STALLED
            break
        there, damping, promised = below
        gain = here.evaluation.criterion - there.evaluation.criterion
        damping = (
            damping / 10.0
            if gain > 0.5 * promised
            else damping * 2.0
            if gain < 0.1 * promised
            else damping
        )
        damping = damping if damping > 1e-8 else 0.0
        gains.append(gain)
        here = there
    return Solution(
        point=here.point,
        nuisances=here.nuisances,
        evaluation=here.evaluation,
        information=here.normal.information,
        tangent=here.point.tangent(),
        status=status,
        iterations=iteration,
        decrement=float(decrement),
    )


class _Place(NamedTuple):
    """Where a descent stands: the matrices with their nuisances, the criterion and its slopes."""

    point: Parametrisation
    nuisances: tuple[Nuisance, ...]
    evaluation: Evaluation
    normal: Normal


class _Descent(NamedTuple):
    """What stays the same while the criterion of `records` falls; `radius` is that of the predictor
    at most."""

    records: Sequence[Record]
    settings: Settings
    radius: float

    def begin(self, point: Parametrisation, nuisances: Sequence[Nuisance] | None) -> _Place:
        """The start. Raises `FitError` where it is useless."""
        records, settings = self.records, self.settings
        if not _allowed(point.system, settings, self.radius):
            raise FitError(
                "the start has an unstable predictor", fix="start from a subspace method"
            )
        current = (
            tuple(nuisances)
            if nuisances is not None
            else start_nuisances(point.system, records, settings)
        )
        here = evaluate(point.system, current, records, np.eye(len(point.system.c)))
        if not np.isfinite(here.criterion):
            raise FitError(
                "the criterion is not finite at the start: an output is predicted without error",
                fix="lower the order, or drop outputs that are combinations of others",
            )
        normal = normal_equations(point, records, here, settings)
        if not _finite(normal):
            raise FitError(
                "the sensitivities are not finite at the start",
                fix="start from another method or a lower order",
            )
        return _Place(point, current, here, normal)

    def below(
        self, here: _Place, model: _Quadratic, damping: float, tries: int
    ) -> tuple[_Place, float, float] | None:
        """(a lower place, the damping that it took, the decrease that its step promised); None
        where `tries` steps, damped ever more, find none."""
        for _ in range(tries):
            step, promised = model.step(damping)
            trial = here.point.moved(step)
            if _allowed(trial.system, self.settings, self.radius):
                moved = self._moved(trial.system, here, step)
                there = evaluate(trial.system, moved, self.records, here.evaluation.noise)
                if there.criterion < here.evaluation.criterion:
                    normal = normal_equations(trial, self.records, there, self.settings)
                    if _finite(normal):
                        return _Place(trial, moved, there, normal), damping, promised
            damping = max(damping, 1e-6) * 8.0
        return None

    def _moved(self, system: Matrices, here: _Place, step: FloatArray) -> tuple[Nuisance, ...]:
        """Nuisances after a step to `system`: the best ones, since in initial state and matrices
        together the innovations are far from linear, and steps along their tangent alone would
        have to be short. Of records with holes, or where modes coincide, those are too dear."""
        moved = _moved(here.nuisances, here.normal.back, step)
        if not Modes(system.predictor).usable:
            return moved
        whole = [r for r in self.records if not r.missing]
        best = iter(start_nuisances(system, whole, self.settings, here.evaluation.noise))
        pairs = zip(self.records, moved, strict=True)
        return tuple(v if r.missing else next(best) for r, v in pairs)


def _forgetful(settings: Settings, point: Parametrisation, records: Sequence[Record]) -> float:
    """Radius within which the predictor forgets its start over the longest record, if the start of
    the fit lies there.

    A mode that does not is no filter but an undamped line that the free initial state fits to the
    noise: it raises the likelihood of these records and ruins the prediction of others. Not for K =
    0: there the modes are the plant's own.
    """
    limit = min(settings.radius, 1.0 - FORGET / max(len(r) for r in records))
    if not np.any(point.system.k) or spectral_radius(point.system.predictor) >= limit:
        return settings.radius
    return limit


def _allowed(system: Matrices, settings: Settings, radius: float) -> bool:
    if not all(np.isfinite(v).all() for v in system):
        return False
    if spectral_radius(system.predictor) >= radius:
        return False
    return not settings.stable or spectral_radius(system.a) < settings.radius


def _finite(normal: Normal) -> bool:
    parts = normal.information, normal.gradient, _at_unit_information(normal)[0]
    return all(np.isfinite(v).all() for v in parts)


def _at_unit_information(normal: Normal) -> tuple[FloatArray, FloatArray]:
    """(Hessian (d, d) with every direction at unit information, the scale (d,) of each)."""
    diagonal = np.diag(normal.information)
    scale = np.sqrt(np.maximum(diagonal, 1e-14 * max(float(diagonal.max(initial=0.0)), 1e-300)))
    with np.errstate(over="ignore", invalid="ignore"):
        return normal.hessian / np.outer(scale, scale), scale


class _Quadratic(NamedTuple):
    """The quadratic model of the criterion in the eigenvectors of its Hessian, every direction at
    unit information.

    Negative curvature is taken by its size, so that a step descends there too (Dauphin et al. 2014,
    "saddle-free").
    """

    values: FloatArray
    slope: FloatArray
    back: FloatArray

    @classmethod
    def of(cls, normal: Normal) -> _Quadratic:
        hessian, scale = _at_unit_information(normal)
        values, vectors = np.linalg.eigh(hessian)
        return cls(values, vectors.T @ (normal.gradient / scale), vectors / scale[:, None])

    @property
    def convex(self) -> bool:
        return not len(self.values) or bool(self.values[0] > -1e-6 * self.values[-1])

    @property
    def decrement(self) -> float:
        """Decrease of -2 log likelihood that a full step promises, over directions that the data
        see."""
        size = np.abs(self.values)
        keep = size > 1e-10 * size.max(initial=0.0)
        return float((self.slope[keep] ** 2 / size[keep]).sum())

    def step(self, damping: float) -> tuple[FloatArray, float]:
        """The damped step (d,) and the decrease that it promises."""
        size = np.abs(self.values)
        step = self.slope / (np.maximum(size, 1e-10 * size.max(initial=0.0)) + damping)
        return self.back @ step, float(2.0 * self.slope @ step - (self.values * step) @ step)


def _moved(
    nuisances: Sequence[Nuisance], back: Sequence[tuple[FloatArray, FloatArray]], step: FloatArray
) -> tuple[Nuisance, ...]:
    out = []
    for v, (start, slope) in zip(nuisances, back):
        change = start - slope @ step
        n = len(v.x0)
        out.append(Nuisance(x0=v.x0 + change[:n], offset=v.offset + change[n:]))
    return tuple(out)
