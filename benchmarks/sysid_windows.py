"""Half seconds of flights between measured states: what peers learn from and are judged by."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from greybox.data import Dataset
from greybox.model.vehicle import Vehicle
from greybox.symbolic import FloatArray
from greybox.validation.groups import GROUPS, error_vectors
from greybox.validation.open_loop import IntArray

JUDGED = ("position", "velocity", "rotation", "rate")
START_LAG, MEMORY = 0.04, 0.5
"""Motor lag that peers start from, and how much of the commands before an instant rotors remember
[s]."""
REFITS, SAME = 5, 0.005
"""How often a peer fits again at most, and the relative change of the lag that needs no further
fit."""
COMPARED = ("motor_lag.tau", "inertia.xx", "inertia.yy", "inertia.zz")
"""Parameters of drawn craft that all estimate."""
Errors = dict[str, FloatArray]
"""Group -> squared norms of errors (instants, steps)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Window:
    """A piece of a flight: measured states (H + 1, 13) of position, quaternion, world
    velocity and body rates, thrusts that were commanded (H + 1, 4) [N] by the vehicle file, and
    those of the time before (m, 4)."""

    measured: FloatArray
    commanded: FloatArray
    before: FloatArray


def numbers(vehicle: Vehicle) -> dict[str, float]:
    """What the file says: mass, moments of inertia, thrust and torque maps."""
    return {name: q.value for name, q in vehicle.quantities.items()}


def groups_at(states: FloatArray) -> dict[str, FloatArray]:
    """Group -> values of states (..., 13)."""
    return {
        "position": states[..., :3],
        "rotation": states[..., 3:7],
        "velocity": states[..., 7:10],
        "rate": states[..., 10:],
    }


def difference(states: FloatArray, reference: FloatArray) -> FloatArray:
    """Errors (..., 12) of states (..., 13): position, velocity, rotation vector, rate."""
    told, seen = groups_at(states), groups_at(reference)
    return np.concatenate([error_vectors(g, told[g], seen[g]) for g in JUDGED], axis=-1)


def windows_of(
    data: Dataset, vehicle: Vehicle, origins: Mapping[str, IntArray], seconds: float
) -> list[Window]:
    """The windows of `seconds` that begin at `origins` of each flight's first segment and miss no
    sample."""
    values, found = numbers(vehicle), []
    for flight in data:
        segment, steps = flight.segments[0], round(seconds / flight.dt)
        states = np.hstack(
            [
                segment.matrix(GROUPS[g].columns)
                for g in ("position", "rotation", "velocity", "rate")
            ]
        )
        u = segment.matrix([f"u{i + 1}" for i in range(len(vehicle.rotors))])
        thrust = sum(values[f"thrust.c{k}"] * u**k for k in range(3))
        memory = round(MEMORY / flight.dt)
        for k in origins[flight.name]:
            measured = states[k : k + steps + 1].copy()
            if np.isfinite(measured).all():
                q = measured[:, 3:7]
                q *= np.where(q @ q[0] < 0.0, -1.0, 1.0)[:, None]
                found.append(
                    Window(
                        measured=measured,
                        commanded=thrust[k : k + steps + 1],
                        before=thrust[k - memory : k],
                    )
                )
    return found


def instants(data: Dataset, first: float, spacing: float, seconds: float) -> dict[str, IntArray]:
    """Flight -> samples from `first` [s] on, every `spacing`, whose window of `seconds`
    lies inside its first segment and is complete."""
    out = {}
    for flight in data:
        segment, steps = flight.segments[0], round(seconds / flight.dt)
        columns = [c for g in JUDGED for c in GROUPS[g].columns]
        there = np.isfinite(segment.matrix(columns)).all(axis=1)
        k = np.arange(
            round(first / flight.dt), segment.n - steps - 1, max(1, round(spacing / flight.dt))
        )
        out[flight.name] = k[[bool(there[i : i + steps + 1].all()) for i in k]]
    return out


def squared(predicted: FloatArray, windows: Sequence[Window]) -> Errors:
    """Squared error norms of predicted states (windows, H, 13)."""
    seen = np.stack([w.measured[1:] for w in windows])
    told, real = groups_at(predicted), groups_at(seen)
    return {g: np.square(error_vectors(g, told[g], real[g])).sum(axis=-1) for g in JUDGED}


def scale_of(windows: Sequence[Window]) -> FloatArray:
    """What each signal (12,) changes by within the windows, by which its error is divided."""
    moved = np.concatenate([difference(w.measured[:1], w.measured[1:]) for w in windows])
    return np.asarray(np.sqrt(np.mean(moved**2, axis=0)))


def rotors_at_start(window: Window, dt: float, lag: float) -> FloatArray:
    """Thrusts (rotors,) [N] of a first-order lag [s] behind the commands of before."""
    keep, thrust = np.exp(-dt / lag), window.before[0].copy()
    for command in window.before[1:]:
        thrust = keep * thrust + (1.0 - keep) * command
    return np.asarray(thrust)
