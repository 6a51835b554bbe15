"""Channel groups of the multi-step tables: which columns they hold, their unit, and the norm of their error.

The metric is that of the nano-drone benchmark of R. Busetto et al., 2026 ("IDSIA metric"): Euclidean norms, and for the
rotation the geodesic angle between predicted and measured attitude.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from greybox.errors import DataError, UnknownNameError
from greybox.frames import numeric
from greybox.model.sensors import USUAL
from greybox.symbolic import FloatArray


@dataclass(frozen=True, kw_only=True)
class Group:
    """A vector quantity: `columns` of the data, `dimension` of its values, unit of its error.

    `error_dimension` is that of its covariance: 3 for the rotation, whose error is a rotation vector in body axes.
    """

    name: str
    unit: str
    columns: tuple[str, ...]
    error_dimension: int = 3

    @property
    def dimension(self) -> int:
        """Number of columns."""
        return len(self.columns)


GROUPS = {
    g.name: g
    for g in (
        Group(
            name=s.group,
            unit=s.innovation_signals(None)[0].unit,
            columns=tuple(x.name for x in s.signals(None)),
        )
        for s in USUAL
    )
}
"""The groups of the usual sensors by name, in the order of the tables."""


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


def error_vectors(name: str, predicted: FloatArray, reference: FloatArray) -> FloatArray:
    """reference - predicted, (..., 3); for the rotation the rotation vector [rad] from predicted to reference.

    `predicted`, `reference`: (..., dimension); a row with NaN or infinity gives NaN. q and -q are the same attitude.
    Raises `DataError` for quaternions that are not of unit norm, `UnknownNameError` for an unknown group.
    """
    if group(name).name != "rotation":
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


def error_norms(name: str, predicted: FloatArray, reference: FloatArray) -> FloatArray:
    """Norm of `error_vectors`, (...): for the rotation the geodesic angle [rad], 0 .. pi. Raises as that does."""
    norms: FloatArray = np.linalg.norm(error_vectors(name, predicted, reference), axis=-1)
    return norms
