"""Calibration of multi-step uncertainty: how much process noise a prediction without measurements really collects.

The filter's noise levels are those of one-step errors. Over a horizon the discrepancy is correlated in time in ways that a
first-order disturbance does not catch, and an estimate of its level from one step ahead is too small (or too large) at
half a second. The covariance h samples ahead is affine in the squared levels,

    Sigma_h = Sigma_h(filter error, parameters, learned part) + sum_g kappa_g^2 Sigma_h(noise of group g),

so that the factors kappa_g of the groups (force, torque, ...) follow from the multi-step errors of the training flights by
maximum likelihood at little cost. The filter keeps its own levels. (Kuleshov, Fenner and Ermon 2018, ICML, recalibrate
quantiles after the fact; here the stated physics of the error growth stays.)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import scipy.optimize

from greybox.data import Dataset
from greybox.errors import DataError, FitError
from greybox.estimation.filtering import Filter, Filtered
from greybox.estimation.propagation import Propagator
from greybox.model.identified import IdentifiedModel
from greybox.symbolic import FloatArray
from greybox.validation.predictive import gaussian_nlpd

HORIZONS = (5, 10, 20, 35, 50)
LIMITS = (0.1, 10.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class Calibration:
    """The model with `horizon_noise`, the factor of every noise group, and the mean density gained [nat per error]."""

    model: IdentifiedModel
    factors: Mapping[str, float]
    gain: float


@dataclass(frozen=True, kw_only=True, eq=False)
class _Errors:
    """Errors (N, d) of one channel block with the parts of their covariance: base (N, d, d), by group (G, N, d, d)."""

    e: FloatArray
    base: FloatArray
    parts: FloatArray


def calibrate_horizons(
    model: IdentifiedModel, data: Dataset, *, horizons: Sequence[int] = HORIZONS, spacing: float = 0.25
) -> Calibration:
    """Fit the factors on all flights of `data`, from origins `spacing` seconds apart.

    Every channel block of the innovation (position, attitude, rate, ...) and every horizon counts the same. The
    accelerometer, whose errors are its own noise, is left out where anything else is measured. Raises `DataError` where
    no flight is long enough.
    """
    groups = list(dict.fromkeys(n.removeprefix("disturbance.").split(".")[0] for n in model.dynamics.noises.names))
    members = np.array(
        [groups.index(n.removeprefix("disturbance.").split(".")[0]) for n in model.dynamics.noises.names]
    )
    runner = Filter(model)
    levels = model.process_noise
    variants = [np.zeros_like(levels), *(np.where(members == g, levels, 0.0) for g in range(len(groups)))]
    # First everything but the noise, then the same without parameters, then one noise group at a time.
    propagators = [Propagator(runner, noise=variants[0])]
    propagators += [Propagator(runner, parameters=False, noise=v) for v in variants]
    blocks = _blocks(model)
    found: list[_Errors] = []
    longest = max(horizons)
    for flight in data:
        for segment in flight.segments:
            step = max(1, round(spacing / segment.dt))
            origins = np.arange(step, segment.n - longest - 1, step)
            if not origins.size:
                continue
            filtered = runner.run(segment)
            try:
                runs = [list(p.run(filtered, origins, longest)) for p in propagators]
            except FitError:
                continue
            for h in horizons:
                at = [r[h - 1] for r in runs]
                e = _errors(runner, filtered, at[0].states, origins + h)
                seen = filtered.record.mask[origins + h] != 0
                for rows in blocks:
                    keep = seen[:, rows].all(axis=1)
                    if keep.any():
                        c = np.array([a.innovation_covariance[keep][:, rows][:, :, rows] for a in at])
                        found.append(_Errors(e=e[keep][:, rows], base=c[0], parts=c[2:] - c[1]))
    if not found:
        raise DataError("no flight is long enough to calibrate multi-step uncertainty", expected=f"{longest} samples")

    def cost(log_factors: FloatArray) -> float:
        return float(np.mean([_density(f, np.exp(2 * log_factors)) for f in found]))

    start = np.zeros(len(groups))
    bounds = [tuple(np.log(LIMITS))] * len(groups)
    best = scipy.optimize.minimize(cost, start, method="L-BFGS-B", bounds=bounds)
    factors = np.exp(best.x)
    return Calibration(
        model=replace(model, horizon_noise=levels * factors[members]),
        factors=dict(zip(groups, factors.tolist(), strict=True)), gain=cost(start) - float(best.fun),
    )  # fmt: skip


def _blocks(model: IdentifiedModel) -> list[list[int]]:
    """Places of the innovation components that are judged together: those of one sensor (one channel, where unknown)."""
    names = getattr(model.physics, "channel_groups", None) or model.dynamics.innovations.names
    blocks = {n: [i for i, m in enumerate(names) if m == n] for n in dict.fromkeys(names)}
    if len(blocks) > 1:
        blocks.pop("specific_force", None)
    return list(blocks.values())


def _errors(runner: Filter, filtered: Filtered, states: FloatArray, rows: npt.NDArray[np.int_]) -> FloatArray:
    """Innovations (m, n_e) of the measurements at `rows` (m,) against predicted states (m, n_x)."""
    record, one = filtered.record, np.ones(len(rows), dtype=np.int32)
    return runner.engine.windows(
        starts=states, rows=rows, lengths=one, tails=one, inputs=record.inputs, outputs=record.outputs,
        mask=record.mask, p=filtered.p, dt=record.dt,
    ).innovations  # fmt: skip


def _density(errors: _Errors, squares: FloatArray) -> float:
    covariance = errors.base + np.einsum("g,gnij->nij", squares, errors.parts)
    return float(gaussian_nlpd(errors.e, covariance).mean())
