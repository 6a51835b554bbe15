"""Arrays as validation takes them: one array per uninterrupted stretch of a flight, time first, NaN
= missing sample.

An infinite value is never a missing sample: it is refused. Missing samples are masked and counted,
nothing is filled in.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from greybox.errors import DataError
from greybox.symbolic import BoolArray, FloatArray


def columns(values: npt.ArrayLike, *, what: str) -> FloatArray:
    """`values` as a float array (N, d); (N,) becomes (N, 1). Raises `DataError` for another shape
    or for infinities."""
    array = np.asarray(values, dtype=np.float64)
    if array.ndim == 1:
        array = array[:, None]
    if array.ndim != 2:
        raise DataError(
            f"{what}: wrong shape", expected="(N,) or (N, d), time first", got=str(array.shape)
        )
    bad = np.isinf(array).any(axis=1)
    if bad.any():
        raise DataError(
            f"{what}: infinite value in {int(bad.sum())} of {len(array)} samples, the first at "
            f"{int(bad.argmax())}",
            fix="write NaN for a missing sample; an infinite prediction means that the model "
            "diverged",
        )
    return array


def complete_rows(rows: FloatArray) -> BoolArray:
    """Which rows of (N, d) have every component, (N,) booleans."""
    return np.asarray(np.isfinite(rows).all(axis=1), dtype=np.bool_)


def stretches(values: Sequence[npt.ArrayLike] | npt.ArrayLike, *, what: str) -> list[FloatArray]:
    """A list of (N_i, d) arrays from one array or from a sequence of them, all with the same d.

    Raises `DataError` where there are none, or where the number of columns differs.
    """
    if isinstance(values, np.ndarray):
        parts = [columns(values, what=what)]
    else:
        parts = [columns(v, what=what) for v in values]  # type: ignore[union-attr]
    if not parts:
        raise DataError(f"{what}: no data", expected="at least one array")
    widths = {p.shape[1] for p in parts}
    if len(widths) > 1:
        raise DataError(f"{what}: arrays of different width", got=str(sorted(widths)))
    return parts


def names_for(names: Sequence[str] | None, width: int, *, what: str) -> tuple[str, ...]:
    """The given names, checked against the number of columns; numbered names where none are
    given. Raises `DataError`."""
    if names is None:
        return tuple(f"{what}{i + 1}" for i in range(width))
    if len(names) != width:
        raise DataError(f"{what}: {len(names)} names for {width} columns", got=", ".join(names))
    return tuple(names)


def pairs(
    measured: npt.ArrayLike, predicted: npt.ArrayLike, mask: npt.ArrayLike | None = None
) -> tuple[FloatArray, FloatArray, int]:
    """Rows (n, d) of measured and predicted that can be compared, and the number of samples left
    out.

    A row is left out where any measured component is missing (NaN) or where `mask` (N,) is False. A
    prediction that is missing where the measurement is there is refused: leaving it out would
    flatter a model that failed. Raises `DataError` for that, for different shapes, and where
    nothing is left.
    """
    y, p = columns(measured, what="measured"), columns(predicted, what="predicted")
    if y.shape != p.shape:
        raise DataError(
            "measured and predicted differ in shape", expected=str(y.shape), got=str(p.shape)
        )
    keep = complete_rows(y)
    if mask is not None:
        chosen = np.asarray(mask)
        if chosen.dtype != np.bool_ or chosen.shape != keep.shape:
            raise DataError(
                "wrong mask",
                expected=f"({len(keep)},) booleans",
                got=f"{chosen.shape} {chosen.dtype}",
            )
        keep &= chosen
    lost = keep & ~complete_rows(p)
    if lost.any():
        raise DataError(
            f"the prediction is NaN in {int(lost.sum())} samples that were measured, the first at "
            f"{int(lost.argmax())}",
            fix="mask these samples on purpose, or look for the step where the model diverged",
        )
    if not keep.any():
        raise DataError(
            "no sample to compare",
            fix="check that the channel was logged and that the mask is not empty",
        )
    return y[keep], p[keep], int(len(keep) - keep.sum())
