"""Calibration of multi-step uncertainty: how much process noise a prediction without measurements really collects.

The filter's noise levels are those of one-step errors. Over a horizon the discrepancy is correlated in time in ways that a
first-order disturbance does not catch, and an estimate of its level from one step ahead is too small (or too large) at
half a second. The covariance h samples ahead is affine in the squared levels,

    Sigma_h = Sigma_h(filter error, parameters) + sum_g kappa_g^2 Sigma_h(noise of group g) + kappa_l^2 Sigma_h(learned)

so that the factors kappa_g of the groups (force, torque, ...) and, at most one, that of the learned part follow from the
multi-step errors of the training flights by maximum likelihood at little cost. The filter keeps its own levels.

(Kuleshov, Fenner and Ermon 2018, ICML, recalibrate quantiles after the fact; here the stated physics of the error growth
stays.)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
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
    """The model with `horizon_noise`, the factor of every noise group, the mean density gained [nat per error], and the
    factor on the standard deviation of the learned part, which is left to the caller (1 without one)."""

    model: IdentifiedModel
    factors: Mapping[str, float]
    gain: float
    learned: float = 1.0


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
    work = _Parts(Filter(model), model.process_noise, split_learned=True)
    found: list[_Errors] = []
    for flight in data:
        for segment in flight.segments:
            step = max(1, round(spacing / segment.dt))
            origins = np.arange(step, segment.n - max(horizons) - 1, step)
            if origins.size:
                found += work.errors(work.runner.run(segment), origins, horizons)
    if not found:
        raise DataError(
            "no flight is long enough to calibrate multi-step uncertainty", expected=f"{max(horizons)} samples"
        )

    def cost(log_factors: FloatArray) -> float:
        return float(np.mean([_density(f, np.exp(2 * log_factors)) for f in found]))

    limits = [LIMITS] * len(work.groups) + [(LIMITS[0], 1.0)] * work.split_learned
    factors, best = _solve(cost, limits)
    return Calibration(
        model=replace(model, horizon_noise=model.process_noise * factors[work.members]),
        factors=dict(zip(work.groups, factors.tolist(), strict=False)), gain=cost(np.zeros(factors.size)) - best,
        learned=float(factors[-1]) if work.split_learned else 1.0,
    )  # fmt: skip


class _Parts:
    """Errors ahead of origins with the parts of their covariance: noise groups, then (`split_learned`) the learned part."""

    def __init__(
        self,
        runner: Filter,
        levels: FloatArray,
        *,
        split_learned: bool = False,
    ) -> None:
        model = runner.model
        heads = [n.removeprefix("disturbance.").split(".")[0] for n in model.dynamics.noises.names]
        self.runner = runner
        self.groups = list(dict.fromkeys(heads))
        self.members = np.array([self.groups.index(h) for h in heads])
        self.blocks = _blocks(model)
        self.split_learned = split_learned and hasattr(model.dynamics, "learned_variance")
        none = np.zeros_like(levels)
        # What no factor touches, the filter's error alone, then one part at a time on top of it.
        self.propagators = [
            Propagator(runner, noise=none, learned=not self.split_learned),
            Propagator(runner, parameters=False, noise=none, learned=False),
        ]
        for g in range(len(self.groups)):
            own = np.where(self.members == g, levels, 0.0)
            self.propagators.append(Propagator(runner, parameters=False, noise=own, learned=False))
        if self.split_learned:
            self.propagators.append(Propagator(runner, parameters=False, noise=none))

    def errors(self, filtered: Filtered, origins: npt.NDArray[np.int_], horizons: Sequence[int]) -> list[_Errors]:
        """Per horizon and channel block; nothing where a prediction is not finite."""
        try:
            runs = [list(p.run(filtered, origins, max(horizons))) for p in self.propagators]
        except FitError:
            return []
        found = []
        for h in horizons:
            at = [r[h - 1] for r in runs]
            e = _errors(self.runner, filtered, at[0].states, origins + h)
            seen = filtered.record.mask[origins + h] != 0
            for rows in self.blocks:
                keep = seen[:, rows].all(axis=1)
                if keep.any():
                    c = np.array([a.innovation_covariance[keep][:, rows][:, :, rows] for a in at])
                    found.append(_Errors(e=e[keep][:, rows], base=c[0], parts=c[2:] - c[1]))
        return found


def _solve(cost: Callable[[FloatArray], float], limits: Sequence[tuple[float, float]]) -> tuple[FloatArray, float]:
    """(factors, least cost) within limits, from one."""
    best = scipy.optimize.minimize(
        cost, np.zeros(len(limits)), method="L-BFGS-B", bounds=[tuple(np.log(limit)) for limit in limits]
    )
    return np.exp(best.x), float(best.fun)


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
