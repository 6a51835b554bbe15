"""What the physics misses, sample by sample: smoothed disturbance force and torque with the
features they may depend on.

The model's filter carries the discrepancy as disturbance states; the smoothed states given the
whole flight are the targets of a residual Gaussian process, never differentiated signals
(Kristensen, Madsen and Jorgensen 2004). Smoothed values of neighbouring samples are almost copies
of each other, so targets and features are averaged over blocks of about the correlation time of the
disturbance; what is faster than that the disturbance states do not resolve anyway.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from greybox.data import Dataset, Segment
from greybox.errors import ModelError
from greybox.estimation.filtering import Filter
from greybox.estimation.fit import fit, noise_of
from greybox.estimation.smoothing import smooth
from greybox.model.identified import IdentifiedModel
from greybox.model.layer import physics_of
from greybox.model.noise import disturbances
from greybox.residual.features import feature_function, feature_layout, reach
from greybox.symbolic import BoolArray, FloatArray, Layout, evaluate

GROUPS = ("force", "torque")


@dataclass(frozen=True, kw_only=True, eq=False)
class Discrepancy:
    """Features z (N, n_in) and targets y (N, n_out) [N, N m], block means in time order, with the
    flight of every row."""

    inputs: Layout
    outputs: Layout
    z: FloatArray
    y: FloatArray
    flights: tuple[str, ...]

    def select(self, names: Sequence[str]) -> Discrepancy:
        """The same rows with some of the features. Raises `UnknownNameError`."""
        at = [self.inputs[n] for n in names]
        return replace(self, inputs=Layout([self.inputs.signals[i] for i in at]), z=self.z[:, at])

    def take(self, rows: BoolArray) -> Discrepancy:
        """The rows where `rows` (N,) says so."""
        kept = tuple(f for f, r in zip(self.flights, rows, strict=True) if r)
        return replace(self, z=self.z[rows], y=self.y[rows], flights=kept)


def disturbed_model(model: IdentifiedModel, data: Dataset) -> IdentifiedModel:
    """`model` with disturbance states whose levels and time constants are fitted to `data`: for
    force and torque, of a model of the user's own for every group of its process noise.

    A model that has disturbance states already is returned as it is. Shared physical parameters
    keep their estimates and covariance; per-flight ones are fitted along. Raises `ModelError` for a
    vehicle whose noises are neither, and for a model without process noise.
    """
    if disturbances(model.dynamics):
        return model
    heads = tuple(dict.fromkeys(n.split(".")[0] for n in model.dynamics.noises.names))
    groups = (
        tuple(g for g in GROUPS if g in heads) if physics_of(model.dynamics) is not None else heads
    )
    if not groups:
        raise ModelError(
            "the model has no process noise that a disturbance could enter by",
            got=", ".join(model.dynamics.noises.names) or "no process noise",
            fix="force or torque of a vehicle; noise_states of a model of your own",
        )
    own = tuple(n for n in model.flight_spread)
    result = fit(
        model.dynamics,
        data,
        disturbance=groups,
        free=(*own, *(f"disturbance.{g}.T" for g in groups)),
        per_flight=own,
        values=dict(model.values),
        noise=noise_of(model),
        estimate_noise="process",
        initialisation="nominal",
    ).model
    return replace(
        result,
        covariance_names=model.covariance_names,
        covariance=model.covariance,
        considered=model.considered,
        form_covariance=model.form_covariance,
        source=model.source,
        trained_on=model.trained_on,
        recipes=model.recipes,
        data_hash=model.data_hash,
    )


def smoothed_features(
    runner: Filter, segment: Segment, look: ca.Function
) -> tuple[FloatArray, FloatArray]:
    """Smoothed states (n, n_x) of one segment, and there the features (n, m) of `look`, a
    `feature_function`."""
    found = smooth(runner, runner.run(segment))
    n, width = len(found.states), sum(runner.model.dynamics.window) + 1
    window = found.filtered.record.inputs[np.arange(n)[:, None] + np.arange(width)].reshape(n, -1)
    return found.states, evaluate(look, found.states, window)


def discrepancy(
    model: IdentifiedModel, data: Dataset, names: Sequence[str], *, block: int | None = None
) -> Discrepancy:
    """Smoothed disturbances of all flights with the features `names`. `model` has disturbance
    states (`disturbed_model`). `block`: samples that a row is the mean of, by default the
    correlation time, at most half a second.

    Where features look back rows are single samples, one per block: means would mix what lags tell
    apart.
    """
    return discrepancy_and_features(model, data, names, block=block)[0]


def discrepancy_and_features(
    model: IdentifiedModel, data: Dataset, names: Sequence[str], *, block: int | None = None
) -> tuple[Discrepancy, tuple[FloatArray, ...]]:
    """`discrepancy` and the features (n, n_in) of every sample of the segments it is made of.
    Raises `ModelError` for a model without disturbance states."""
    dynamics = model.dynamics
    rows = [i for i, n in enumerate(dynamics.states.names) if n.startswith("disturbance.")]
    if not rows:
        raise ModelError("the model has no disturbance states", fix="use disturbed_model first")
    channels = [dynamics.states.names[i].removeprefix("disturbance.") for i in rows]
    runner = Filter(model)
    look = feature_function(dynamics, names)
    times = [
        model.values[n] for n in model.values if n.startswith("disturbance.") and n.endswith(".T")
    ]
    block = block or max(1, round(min(max(times, default=0.1), 0.5) / model.sample_time))
    z: list[FloatArray] = []
    y: list[FloatArray] = []
    flights: list[str] = []
    samples: list[FloatArray] = []
    for flight in data:
        for segment in flight.segments:
            n = segment.n // block * block
            if not n:
                continue
            states, seen = smoothed_features(runner, segment, look)
            samples.append(seen)
            for found, values in ((z, seen), (y, states[:, rows])):
                blocks = values[:n].reshape(-1, block, values.shape[1])
                found.append(blocks[:, block // 2] if reach(names) else blocks.mean(axis=1))
            flights += [flight.name] * (n // block)
    if not z:
        raise ModelError(
            "no flight is long enough to see its disturbances",
            expected=f"more than {block} samples",
        )
    outputs = Layout([dynamics.noises.signals[dynamics.noises[c]] for c in channels])
    seen_in_all = Discrepancy(
        inputs=feature_layout(dynamics, names),
        outputs=outputs,
        z=np.concatenate(z),
        y=np.concatenate(y),
        flights=tuple(flights),
    )
    return seen_in_all, tuple(samples)
