"""Channel groups of the multi-step tables: which columns they hold, their unit, and the norm of
their error.

The metric is that of the nano-drone benchmark of R. Busetto et al., 2026 ("IDSIA metric"):
Euclidean norms, and for the rotation the geodesic angle between predicted and measured attitude.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from greybox.errors import DataError, UnknownNameError
from greybox.frames import numeric
from greybox.model.dynamics import Dynamics
from greybox.model.layer import physics_of
from greybox.model.sensors import USUAL
from greybox.symbolic import FloatArray


@dataclass(frozen=True, kw_only=True)
class Group:
    """A vector quantity: `columns` of the data, `dimension` of its values, unit of its error.

    `error_dimension` is that of its covariance: 3 for the rotation, whose error is a rotation
    vector in body axes. `own`: an output of a model of the user's own, of which nothing is known
    but its name and unit.
    """

    name: str
    unit: str
    columns: tuple[str, ...]
    error_dimension: int = 3
    own: bool = False

    @property
    def dimension(self) -> int:
        """Number of columns."""
        return len(self.columns)

    @property
    def axes(self) -> tuple[str, ...]:
        """What the components of its error are called, in order; () where there is one."""
        if self.error_dimension == 1:
            return ()
        turning = {"rotation": "{}", "rate": "{} rate"}.get(self.name)
        if turning is not None:
            return tuple(turning.format(a) for a in ("roll", "pitch", "yaw"))
        return tuple(f"{self.name.replace('_', ' ')} {a}" for a in "xyz")


_NO_MATTER: Any = None
"""The vehicle, for the usual sensors: they have the same columns on every one."""
GROUPS = {
    g.name: g
    for g in (
        Group(
            name=s.group,
            unit=s.innovation_signals(_NO_MATTER)[0].unit,
            columns=tuple(x.name for x in s.signals(_NO_MATTER)),
        )
        for s in USUAL
    )
}
"""The groups of the usual sensors by name, in the order of the tables."""


Groups = Mapping[str, Group]


def groups_of(dynamics: Dynamics) -> Groups:
    """The groups that a model is judged in: of a vehicle `GROUPS`; of any other model the groups
    whose columns it has all, and every other output as a group of its own."""
    if physics_of(dynamics) is not None:
        return GROUPS
    names = set(dynamics.outputs.names)
    usual = {n: g for n, g in GROUPS.items() if names.issuperset(g.columns)}
    taken = {c for g in usual.values() for c in g.columns}
    own = {
        s.name: Group(name=s.name, unit=s.unit, columns=(s.name,), error_dimension=1, own=True)
        for s in dynamics.outputs
        if s.name not in taken
    }
    return {**usual, **own}


def group(name: str) -> Group:
    """The group of that name. Raises `UnknownNameError`."""
    try:
        return GROUPS[name]
    except KeyError:
        raise UnknownNameError("channel group", name, GROUPS) from None


def _check_quaternions(q: FloatArray, what: str) -> None:
    norm = np.linalg.norm(q, axis=1)
    bad = np.abs(norm - 1.0) > 0.1
    if bad.any():
        raise DataError(
            f"rotation: {int(bad.sum())} {what} quaternions are not of unit norm",
            expected="(w, x, y, z), norm 1",
            got=f"norm {norm[bad.argmax()]:.3g}",
        )


def error_vectors(which: str | Group, predicted: FloatArray, reference: FloatArray) -> FloatArray:
    """reference - predicted, (..., error dimension); for the rotation the rotation vector [rad]
    from predicted to reference.

    `which` is a group or the name of a usual one. `predicted`, `reference`: (..., dimension); a row
    with NaN or infinity gives NaN. q and -q are the same attitude. Raises `DataError` for
    quaternions that are not of unit norm, `UnknownNameError` for an unknown group.
    """
    kind = group(which) if isinstance(which, str) else which
    if kind.dimension == kind.error_dimension:
        with np.errstate(invalid="ignore"):
            error: FloatArray = reference - predicted
        error[~np.isfinite(error).all(axis=-1)] = np.nan
        return error
    shape = np.broadcast_shapes(predicted.shape, reference.shape)
    p, r = (np.broadcast_to(a, shape).reshape(-1, 4) for a in (predicted, reference))
    seen = np.isfinite(p).all(axis=1) & np.isfinite(r).all(axis=1)
    out = np.full((len(p), 3), np.nan)
    if seen.any():
        _check_quaternions(p[seen], "predicted")
        _check_quaternions(r[seen], "reference")
        out[seen] = numeric("difference", p[seen], r[seen])
    return out.reshape(*shape[:-1], 3)


def error_norms(which: str | Group, predicted: FloatArray, reference: FloatArray) -> FloatArray:
    """Norm of `error_vectors`, (...): for the rotation the geodesic angle [rad], 0 .. pi. Raises as
    that does."""
    norms: FloatArray = np.linalg.norm(error_vectors(which, predicted, reference), axis=-1)
    return norms
