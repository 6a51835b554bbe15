"""Noise levels of the filter with the learned part in place, by the likelihood of the innovations.

The levels of a fit without the learned part hold what the learned part now explains: the filter
would follow disturbances that are no longer there and state too wide an error of its own. One
factor per group (white force, torque, ..., and the driving noise of the disturbances of each) is
refitted; axes keep their ratios, everything else keeps its value (Astrom 1980, Automatica 16(5):
noise levels as parameters of the predictor). With `each` every level is refitted alone: one that a
fit without the learned part drove to nothing, because a slow disturbance took its place, comes
back.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import scipy.optimize

from greybox.data import Dataset
from greybox.errors import FitError
from greybox.estimation.criteria.gaussian import Gaussian
from greybox.estimation.engine import engine_for
from greybox.estimation.filtering import at_reference
from greybox.estimation.predictor import Block
from greybox.estimation.record import make_record
from greybox.estimation.settling import Settling
from greybox.estimation.solved import solved
from greybox.estimation.solver import Value
from greybox.estimation.solvers.levenberg_marquardt import ARRIVED, LevenbergMarquardt
from greybox.estimation.unknown import Unknown
from greybox.model.identified import IdentifiedModel
from greybox.symbolic import FloatArray

LIMITS = (0.02, 5.0)
"""Bounds of the factors on the levels."""
WIDE = (1e-3, 50.0)
"""Bounds of the factors where every level has its own."""
NOT_FINITE = Value(cost=np.inf, likelihood=np.inf, valid=False)


def refit_noise(model: IdentifiedModel, data: Dataset, *, each: bool = False) -> IdentifiedModel:
    """`model` with the process-noise levels that make the innovations of `data` most likely.

    each: refit every level by itself, one after the other (20 s for a minute of flight at 100 Hz).
    Flights use their own per-flight values. Never less likely than before: where no level helps
    all stay.
    """
    heads = [n.rpartition(".")[0] or n for n in model.dynamics.noises.names]
    groups = list(dict.fromkeys(heads))
    members = np.array([groups.index(h) for h in heads])
    likelihood = _Likelihood(model, data, members, len(groups))
    if each:
        own = model.process_noise
        before = likelihood.cost(own)
        found = _one_by_one(likelihood.cost, own, before) if np.isfinite(before) else own
        return replace(model, process_noise=found)
    solver = LevenbergMarquardt(tolerance=ARRIVED)
    factors, _ = solved(likelihood, solver, np.zeros(likelihood.n))  # never worse than they start
    return replace(model, process_noise=likelihood.levels(factors))


class _Likelihood:
    """Negative log likelihood of the innovations of all flights as an objective: unknowns are the
    logarithms of one factor for each of n `groups` of levels, `members` (n_w,) the group of every
    level."""

    def __init__(
        self, model: IdentifiedModel, data: Dataset, members: npt.NDArray[np.int_], groups: int
    ) -> None:
        self._model, self._members, self._linear = model, members, at_reference(model)
        self._engine = engine_for(model.dynamics, ())
        self._runs = [
            (make_record(self._engine, s), model.flight_vector(f.name))
            for f in data
            for s in f.segments
        ]
        low, high = np.log(LIMITS)
        self.unknowns = tuple(
            Unknown(
                name=f"noise group {i}",
                kind="noise",
                flight=None,
                start=0.0,
                lower=float(low),
                upper=float(high),
                mean=0.0,
                sigma=np.inf,
                scale=1.0,
                unit="-",
            )
            for i in range(groups)
        )
        self.n = groups
        self.lower, self.upper = np.full(groups, low), np.full(groups, high)
        self.scale = np.ones(groups)

    def levels(self, theta: FloatArray) -> FloatArray:
        """The process noise (n_w,) at logarithms (n,) of the factors."""
        return np.asarray(self._model.process_noise * np.exp(theta)[self._members])

    def cost(self, levels: FloatArray) -> float:
        """At noise levels (n_w,); infinite where the filter is not finite."""
        return self._evaluated(levels, None).cost

    def evaluate(self, theta: FloatArray, order: int = 1, scores: int | None = None) -> Value:
        """Cost and, for order 1, gradient and Fisher information at `theta` (n,); no scores."""
        levels = self.levels(theta)
        if not order:
            return self._evaluated(levels, None)
        slope = np.zeros((self.n, levels.size))
        slope[self._members, np.arange(levels.size)] = 2 * levels**2
        return self._evaluated(levels, slope)

    def _evaluated(self, levels: FloatArray, slope: FloatArray | None) -> Value:
        model, engine, ns = self._model, self._engine, 0 if slope is None else self.n
        still = tuple(np.zeros((0, *v.shape)) for v in self._linear)
        criterion, order = Gaussian(), int(slope is not None)
        cost, gradient, hessian = 0.0, np.zeros(ns), np.zeros((ns, ns))
        try:
            settling = Settling(
                values=self._linear,
                q=levels**2,
                r=model.sensor_noise**2,
                weak=model.weak**2,
                slopes=None if slope is None else still,
                dq=slope,
                dr=None if slope is None else np.zeros((ns, engine.ne)),
            )
            for record, p in self._runs:
                found = settling.gains(record, record.spread)
                gains, covariance, slopes = found.tables()
                run = engine.run(
                    x0=record.x0,
                    pattern=found.pattern,
                    gains=gains,
                    p=p,
                    s0=None if slope is None else np.zeros((engine.nd, ns)),
                    want=frozenset({"innovations", "sensitivity"}),
                    **record.samples,
                )
                if run.failed_at is not None or run.innovations is None:
                    return NOT_FINITE
                block = Block(
                    record=record,
                    e=run.innovations,
                    mask=record.mask,
                    jacobian=run.sensitivity,
                    columns=np.arange(ns),
                    covariance=covariance,
                    covariance_slope=slopes,
                    pattern=found.pattern,
                )
                c, g, h, _ = criterion.of_block(block, order, None)
                cost += c
                if order:
                    gradient, hessian = gradient + g, hessian + h
        except FitError:
            return NOT_FINITE
        if not order:
            return Value(cost=cost, likelihood=cost)
        return Value(cost=cost, likelihood=cost, gradient=gradient, hessian=hessian)


def _one_by_one(
    cost: Callable[[FloatArray], float], levels: FloatArray, value: float
) -> FloatArray:
    """`levels` (of cost `value`) after Powell's method on their logarithms; never worse."""
    free = np.flatnonzero(levels > 0)

    def moved(v: FloatArray) -> FloatArray:
        out = levels.copy()
        out[free] *= np.exp(v)
        return out

    best = scipy.optimize.minimize(
        lambda v: cost(moved(v)),
        np.zeros(len(free)),
        method="Powell",
        bounds=[tuple(np.log(WIDE))] * len(free),
        options={"xtol": 0.02, "ftol": 1e-7, "maxiter": 6},
    )
    return moved(best.x) if best.fun < value else levels
