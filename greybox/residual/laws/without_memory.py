"""Without memory: the model of a fit with white noise alone."""

from __future__ import annotations

from greybox.data import Dataset
from greybox.estimation.fit import Fit, fit
from greybox.model.identified import IdentifiedModel
from greybox.model.layer import physics_of
from greybox.model.noise import without_parts


def without_memory(settled: Fit, data: Dataset) -> IdentifiedModel:
    """The model of a fit without states of force, torque and sensors, noise levels fitted anew: a
    filter with these takes most of a slow law for noise. Of a small model of one's own all numbers:
    next to a disturbance they only say what is fast. Raises `FitError`."""
    dynamics = without_parts(settled.model.dynamics)
    there = {d.name for d in dynamics.parameters}
    values = {n: float(v) for n, v in settled.model.values.items() if n in there}
    own = [n for n in settled.model.flight_spread if n in there]
    free = own if physics_of(dynamics) else [n for n in settled.parameters if n in there]
    return fit(
        dynamics, data, free=free, values=values, per_flight=own, initialisation="noise"
    ).model
