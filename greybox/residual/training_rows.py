"""Rows that a GP is trained on: complete, numbered by flight, and with their place in what was
given."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from greybox.errors import ModelError
from greybox.residual.selection import IntArray
from greybox.symbolic import BoolArray, FloatArray, Layout

Groups = Sequence[object] | npt.NDArray[np.generic]
"""The flight of each row, named by anything that NumPy tells apart."""
Which = slice | BoolArray | IntArray
LEAST = 20
"""Complete rows without which nothing is trained."""


@dataclass(frozen=True, kw_only=True)
class Rows:
    """Complete rows: z (N, n_in), y (N, n_out), place in the given arrays (N,), number of the group
    (N,)."""

    z: FloatArray
    y: FloatArray
    place: IntArray
    group: IntArray

    def take(self, which: Which) -> Rows:
        """Some of the rows, by mask, index or slice."""
        return Rows(
            z=self.z[which], y=self.y[which], place=self.place[which], group=self.group[which]
        )


def complete_rows(
    z: npt.ArrayLike, y: npt.ArrayLike, groups: Groups | None, inputs: Layout, outputs: Layout
) -> tuple[Rows, list[str], int]:
    """(rows without a NaN, names of their groups in order of appearance, number of dropped rows).
    Raises `ModelError`."""
    z, y = np.asarray(z, dtype=np.float64), np.asarray(y, dtype=np.float64)
    if z.ndim != 2 or z.shape[1] != len(inputs) or y.shape != (len(z), len(outputs)):
        raise ModelError(
            "the training arrays do not fit the layouts",
            expected=f"(N, {len(inputs)}) and (N, {len(outputs)})",
            got=f"{z.shape} and {y.shape}",
        )
    labels = np.zeros(len(z), dtype=int) if groups is None else np.asarray(groups)
    if labels.shape != (len(z),):
        raise ModelError("groups", expected=f"({len(z)},), one per row", got=str(labels.shape))
    if np.isinf(z).any() or np.isinf(y).any():
        raise ModelError("the training arrays hold infinite values")
    keep = np.isfinite(z).all(1) & np.isfinite(y).all(1)
    if keep.sum() < LEAST:
        raise ModelError(
            "too few complete rows to train a GP",
            expected=f"at least {LEAST}",
            got=str(int(keep.sum())),
        )
    at = np.flatnonzero(keep)
    # In order of appearance, so that results do not depend on how flights are called.
    unique, first, inverse = np.unique(labels[at], return_index=True, return_inverse=True)
    order = np.argsort(first)
    group = np.argsort(order)[inverse]
    return (
        Rows(z=z[at], y=y[at], place=at, group=group),
        [str(unique[i]) for i in order],
        int(len(z) - at.size),
    )
