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
import scipy.optimize

from greybox.data import Dataset
from greybox.errors import FitError
from greybox.estimation.engine import engine_for
from greybox.estimation.filtering import at_reference
from greybox.estimation.record import make_record
from greybox.estimation.settling import Settling
from greybox.model.identified import IdentifiedModel
from greybox.symbolic import FloatArray

LIMITS = (0.02, 5.0)
"""Bounds of the factors on the levels."""
WIDE = (1e-3, 50.0)
"""Bounds of the factors where every level has its own."""


def refit_noise(model: IdentifiedModel, data: Dataset, *, each: bool = False) -> IdentifiedModel:
    """`model` with the process-noise levels that make the innovations of `data` most likely.

    each: refit every level by itself, one after the other (20 s for a minute of flight at 100 Hz).
    Flights use their own per-flight values. Never less likely than before: where no level helps,
    the model comes back.
    """
    heads = [n.rpartition(".")[0] or n for n in model.dynamics.noises.names]
    groups = list(dict.fromkeys(heads))
    members = np.array([groups.index(h) for h in heads])
    engine = engine_for(model.dynamics, ())
    linear = at_reference(model)
    runs = [(make_record(engine, s), model.flight_vector(f.name)) for f in data for s in f.segments]

    def cost(levels: FloatArray) -> float:
        try:
            settling = Settling(
                values=linear, q=levels**2, r=model.sensor_noise**2, weak=model.weak**2
            )
            filters = [settling.gains(record, record.spread) for record, _ in runs]
        except FitError:
            return np.inf
        total, count = 0.0, 0
        for (record, p), found in zip(runs, filters, strict=True):
            gains, covariance, _ = found.tables()
            run = engine.run(
                x0=record.x0,
                pattern=found.pattern,
                gains=gains,
                p=p,
                **record.samples,
            )
            if run.failed_at is not None or run.innovations is None:
                return np.inf
            for k, s in enumerate(covariance):
                e = run.innovations[found.pattern == k]
                total += 0.5 * float(np.sum(e @ np.linalg.inv(s) * e)) + 0.5 * len(e) * float(
                    np.linalg.slogdet(s)[1]
                )
                count += len(e)
        return total / max(count, 1)

    own = model.process_noise
    before = cost(own)
    if not np.isfinite(before):
        return model
    if each:
        return replace(model, process_noise=_one_by_one(cost, own, before))
    best = scipy.optimize.minimize(
        lambda v: cost(own * np.exp(v)[members]),
        np.zeros(len(groups)),
        method="Powell",
        bounds=[tuple(np.log(LIMITS))] * len(groups),
        options={"xtol": 0.01, "ftol": 1e-6, "maxiter": 6},
    )
    if not best.fun < before:
        return model
    return replace(model, process_noise=own * np.exp(best.x)[members])


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
