"""Noise levels of the filter with the learned part in place, by the likelihood of the innovations.

The levels of a fit without the learned part hold what the learned part now explains: the filter would follow disturbances
that are no longer there and state too wide an error of its own. One factor per group (white force, torque, ..., and the
driving noise of the disturbances of each) is refitted; axes keep their ratios, everything else keeps its value
(Astrom 1980, Automatica 16(5): noise levels as parameters of the predictor).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.optimize

from greybox.data import Dataset
from greybox.errors import FitError
from greybox.estimation.engine import GainTable, engine_for
from greybox.estimation.gain import Linearisation, stationary
from greybox.estimation.record import make_record
from greybox.model.identified import IdentifiedModel
from greybox.symbolic import FloatArray

LIMITS = (0.02, 5.0)
"""Bounds of the factors on the levels."""


def refit_noise(model: IdentifiedModel, data: Dataset) -> IdentifiedModel:
    """`model` with the process-noise levels that make the innovations of `data` most likely.

    Flights use their own per-flight values. Never less likely than before: where no level helps, the model comes back.
    """
    heads = [n.rpartition(".")[0] or n for n in model.dynamics.noises.names]
    groups = list(dict.fromkeys(heads))
    members = np.array([groups.index(h) for h in heads])
    engine = engine_for(model.dynamics, ())
    past, future = model.dynamics.window
    window = np.repeat(model.reference_inputs[:, None], past + 1 + future, axis=1)
    linear = Linearisation(model.dynamics, ()).values(
        model.reference_state, window, model.parameter_vector(), model.sample_time
    )
    runs = [(make_record(engine, s), model.flight_vector(f.name)) for f in data for s in f.segments]

    def cost(log_factors: FloatArray) -> float:
        levels = model.process_noise * np.exp(log_factors)[members]
        try:
            riccati = stationary(linear, levels**2, model.sensor_noise**2, model.weak**2)
        except FitError:
            return np.inf
        total, count = 0.0, 0
        for record, p in runs:
            parts = [riccati.gain(m) for m in record.patterns]
            gains = GainTable(
                gain=np.array([v[0] for v in parts]),
                zero=np.array([not m.any() for m in record.patterns], dtype=np.int32),
            )
            run = engine.run(
                x0=record.x0, inputs=record.inputs, outputs=record.outputs, mask=record.mask, pattern=record.pattern,
                gains=gains, p=p, dt=record.dt,
            )  # fmt: skip
            if run.failed_at is not None or run.innovations is None:
                return np.inf
            for k, (_, s, *_) in enumerate(parts):
                e = run.innovations[record.pattern == k]
                total += 0.5 * float(np.sum(e @ np.linalg.inv(s) * e)) + 0.5 * len(e) * float(np.linalg.slogdet(s)[1])
                count += len(e)
        return total / max(count, 1)

    start = np.zeros(len(groups))
    before = cost(start)
    if not np.isfinite(before):
        return model
    best = scipy.optimize.minimize(
        cost, start, method="Powell", bounds=[tuple(np.log(LIMITS))] * start.size,
        options={"xtol": 0.01, "ftol": 1e-6, "maxiter": 6},
    )  # fmt: skip
    if not best.fun < before:
        return model
    return replace(model, process_noise=model.process_noise * np.exp(best.x)[members])
