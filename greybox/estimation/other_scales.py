"""What no flight tells, carried into the errors of a fit that held it.

A fit from what is known (`greybox.model.known`) holds one number of those that only show together.
All could be larger by one factor, and every flight would be the same: nothing of the fit changes,
but all these numbers, together. Their errors add so to the covariance.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from greybox.estimation.covariance import correlation
from greybox.estimation.result import Estimate, Fit
from greybox.model.known import SCALE
from greybox.model.units import power_of_mass
from greybox.symbolic import FloatArray


def on_other_scales(found: Fit, untold: Sequence[Mapping[str, float]]) -> Fit:
    """The fit with the errors of what it was `untold`: how numbers move together, by one standard
    error at a time. A force or an inertia that is not among them moves as the mass does: no sensor
    knows the unit of mass."""
    if not untold:
        return found
    model = found.model
    shared, own = model.covariance_names, tuple(model.flight_spread)
    units = {d.name: d.unit for d in model.dynamics.parameters}

    def moved(name: str, together: Mapping[str, float]) -> float:
        if name in together or not together.get(SCALE):
            return together.get(name, 0.0)
        grows = together[SCALE] / model.values[SCALE]
        return model.values[name] * power_of_mass(units.get(name, "")) * grows

    def rows(names: Sequence[str]) -> FloatArray:
        return np.array([[moved(n, t) for t in untold] for n in names]).reshape(-1, len(untold))

    every = rows((*shared, *own))
    covariance = model.covariance + every[: len(shared)] @ every[: len(shared)].T
    flights = model.flight_covariance + every @ every[len(shared) :].T
    held = {}
    for name in sorted({n for t in untold for n in t} - {*shared, *own} & units.keys()):
        (row,) = rows([name])
        variance = float(row @ row)
        moves = zip((*shared, *own), (every @ row / variance).tolist(), strict=True)
        held[name] = (variance**0.5, dict(moves))
    wider = {n: _wider(e, float((rows([n]) ** 2).sum())) for n, e in found.parameters.items()}
    model = replace(
        model,
        covariance=covariance,
        flight_covariance=flights,
        considered={**model.considered, **held},
    )
    estimates = replace(
        found.estimates, model=model, parameters=wider, correlations=correlation(covariance)
    )
    return replace(found, estimates=estimates)


def _wider(e: Estimate, variance: float) -> Estimate:
    """The estimate with a further variance, of each flight the same."""
    each = {f: (v, float(np.hypot(s, variance**0.5))) for f, (v, s) in e.per_flight.items()}
    return replace(e, std=float(np.hypot(e.std, variance**0.5)), per_flight=each)
