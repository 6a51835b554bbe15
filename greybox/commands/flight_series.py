"""Time series of flights for a page: what was measured beside what a model says one step and some
seconds ahead."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from greybox.data import Dataset, Flight
from greybox.estimation.filtering import Filter, Filtered
from greybox.model.identified import IdentifiedModel
from greybox.model.layer import physics_of
from greybox.report.flight_section import ChannelSeries, FlightSeries
from greybox.report.replay import ORIGINS, SECONDS, STEP, Replay
from greybox.symbolic import FloatArray
from greybox.validation.adapt import AdaptedRow

POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
"""Outputs that say where a craft is."""


def series(
    model: IdentifiedModel,
    *datasets: Dataset,
    adapted: Mapping[str, Mapping[str, AdaptedRow]] | None = None,
    ahead_seconds: float = 0.5,
    limit: int = 1,
) -> dict[str, FlightSeries]:
    """Time series of `limit` flights per data set for the report (15 figures each): measured, one
    step and some ahead."""
    chosen: list[tuple[str, Flight]] = []
    roles: Sequence[str] = ("train", "test")
    for role, data in zip(roles, datasets, strict=False):
        chosen += [(role, f) for f in data.flights[:limit]]
    runner = Filter(model)
    out: dict[str, FlightSeries] = {}
    for role, flight in chosen:
        segment = max(flight.segments, key=lambda s: s.n)
        filtered = runner.run(segment, p=flight_parameters(model, (adapted or {}).get(flight.name)))
        seconds, ahead = ahead_of(runner, filtered, ahead_seconds)
        channels = {
            signal.name: ChannelSeries(
                measured=filtered.record.outputs[:, j],
                unit=signal.unit,
                one_step=filtered.outputs[:, j],
                ahead=ahead[:, j],
            )
            for j, signal in enumerate(model.dynamics.outputs)
        }
        out[flight.name] = FlightSeries(
            t=segment.t,
            channels=channels,
            ahead_seconds=seconds,
            role=role,
            replay=_replay(runner, filtered, segment.t),
        )
    return out


def flight_parameters(
    model: IdentifiedModel, own: Mapping[str, AdaptedRow] | None
) -> FloatArray | None:
    """The parameter vector of a flight with values of its own ({name: {value: ...}}), None where
    there are none."""
    if not own:
        return None
    vector: FloatArray = model.parameter_vector(
        {k: v["value"] for k, v in own.items() if k in model.values}
    )
    return vector


def ahead_of(runner: Filter, filtered: Filtered, seconds: float) -> tuple[float, FloatArray]:
    """(seconds, in whole steps; outputs (n, n_y), each as it was predicted that long before, NaN at
    the beginning)."""
    steps = max(1, round(seconds / runner.model.sample_time))
    origins = np.arange(0, max(filtered.record.n - steps - 1, 0))
    ahead = np.full_like(filtered.outputs, np.nan)
    if origins.size:
        ahead[origins + steps] = runner.rollout(filtered, origins, steps)[:, -1]
    return steps * runner.model.sample_time, ahead


def _replay(runner: Filter, filtered: Filtered, t: FloatArray) -> Replay | None:
    """What was flown and what was said before; None where the model does not put out where the
    craft is."""
    names = [s.name for s in runner.model.dynamics.outputs]
    if not set(POSE) <= set(names):
        return None
    columns = [names.index(n) for n in POSE]
    dt, n = filtered.record.dt, filtered.record.n
    thin = max(1, round(STEP / dt))
    steps = round(SECONDS / (thin * dt))
    stride = thin * max(1, -(-n // (thin * ORIGINS)))
    # A prediction from row k starts at what the filter knew there, and is the next rows' from then
    # on.
    origins = np.arange(0, n - steps * thin - 1, stride)
    if len(origins) < 2:
        return None
    filled = np.where(np.isnan(filtered.record.outputs), filtered.outputs, filtered.record.outputs)[
        :, columns
    ]
    ahead = runner.rollout(filtered, origins, steps * thin)[:, thin - 1 :: thin][..., columns]
    start = filtered.outputs[origins][:, None, columns]
    physics = physics_of(runner.model.dynamics)
    arm = 0.1 if physics is None else physics.vehicle.arm_length
    return Replay(
        begin=float(t[0]),
        step=thin * dt,
        stride=stride * dt,
        arm=arm,
        measured=filled[::thin],
        predicted=np.concatenate([start, ahead], axis=1),
    )
