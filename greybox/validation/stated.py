"""What a model says about its own open-loop errors: the covariance of every channel group, h
samples ahead.

Read off the propagated covariance (`greybox.estimation.propagation`): groups that the model
measures carry the noise of their sensor, for the reference they are judged against is that sensor;
a velocity that the model does not measure is read from the state, and its reference has the noise
that the vehicle file states for it (0.02 m/s where it does not). World vectors are turned from body
axes (where errors live) into the world; the rotation's error is a rotation vector in body axes.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from greybox.estimation.filtering import Filtered
from greybox.estimation.propagation import Propagator
from greybox.frames import numeric
from greybox.model.dynamics import Dynamics
from greybox.model.layer import physics_of
from greybox.symbolic import FloatArray
from greybox.validation.groups import Group, Groups, groups_of
from greybox.validation.open_loop import IntArray

WORLD = ("position", "velocity")


# What no craft has may spread beyond all numbers; the verdict says so, and no warning of numpy.
@np.errstate(over="ignore", invalid="ignore")
def stated_covariances(
    propagator: Propagator,
    filtered: Filtered,
    origins: IntArray,
    *,
    steps: int,
    groups: Iterable[str],
) -> dict[str, FloatArray]:
    """Group -> covariance (m, steps, d, d), d its error dimension, of the error of `predict_from`
    at k+1 .. k+steps from every origin k.

    Origins near the end of the record get NaN: their path leaves it. Raises `FitError` where a
    prediction is not finite.
    """
    dynamics = propagator.runner.model.dynamics
    kinds: Groups = groups_of(dynamics)
    wanted = [g for g in groups if _rows(dynamics, kinds[g]) is not None]
    out = {
        g: np.full((len(origins), steps, *2 * (kinds[g].error_dimension,)), np.nan) for g in wanted
    }
    inside = np.flatnonzero(np.asarray(origins) + 1 + steps <= filtered.record.n)
    if not inside.size or not wanted:
        return out
    attitude = [i for i, n in enumerate(dynamics.states.names) if n.startswith("attitude.")]
    for ahead in propagator.run(filtered, np.asarray(origins)[inside], steps):
        for g in wanted:
            found = _rows(dynamics, kinds[g])
            assert found is not None
            measured, rows = found
            whole = ahead.innovation_covariance if measured else ahead.covariance
            value = whole[:, rows][:, :, rows]
            if not measured:
                value = value + _reference_noise(dynamics, g) ** 2 * np.eye(3)
            if g in WORLD and attitude and not kinds[g].own:
                turn = numeric("matrix", ahead.states[:, attitude]).reshape(-1, 3, 3)
                value = turn @ value @ turn.transpose(0, 2, 1)
            out[g][inside, ahead.h - 1] = value
    return out


def _rows(dynamics: Dynamics, group: Group) -> tuple[bool, list[int]] | None:
    """(measured?, places among the innovations or the error states) of a group; None where the
    model has neither."""
    columns = group.columns
    names = dynamics.outputs.names
    if all(c in names for c in columns):
        rows = [
            i for i, needed in enumerate(dynamics.innovation_columns) if set(needed) <= set(columns)
        ]
        return (True, rows) if len(rows) == group.error_dimension else None
    own = [i for i, n in enumerate(dynamics.error_states.names) if n.startswith(f"d_{group.name}.")]
    return (False, own) if group.name == "velocity" and len(own) == 3 else None


def _reference_noise(dynamics: Dynamics, group: str) -> float:
    physics = physics_of(dynamics)
    return float(physics.vehicle.noise.get(group, 0.02)) if physics is not None else 0.0
