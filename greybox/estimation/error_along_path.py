"""The error of a learned push along a predicted path, for every prediction on its own.

What is wrong with a learned function is one and the same wherever the features are alike, and fresh
where they are not. With K the covariance of the push's errors at the places of a path
(`LearnedErrors`) and K = L L', the error at place t is L_t times independent numbers of variance
one, and each of these travels as a consider state. L grows row by row, as the path does (Cholesky);
a place that has nothing of its own left, but for `SAME` of its variance, adds no number: paths are
smooth, and a vehicle that hovers keeps one.
"""

from __future__ import annotations

import numpy as np

from greybox.model.layer import LearnedErrors
from greybox.symbolic import FloatArray

SAME = 0.01
"""Share of the variance at a place that may be counted with the places before it."""
HELD = 0.01
"""For so long [s] an error stays what it was: of a log at 1 kHz places a millisecond apart would be
ten times as many, for pushes that moved nothing in between."""
LEAST = 1e-6
"""A place that adds a number keeps this share of its variance at least for it, as what follows is
divided by it."""


class ErrorAlongPath:
    """Travels with m predictions. `into` (n_d, n_out): how errors of the push enter the error
    state; open_only: of what no weight can say (`LearnedErrors.together`). What it makes of a state
    or a measurement has a column per output and number: its product with its transpose is a
    covariance."""

    def __init__(self, into: FloatArray, predictions: int, *, open_only: bool) -> None:
        self._into, self._open_only = into, open_only
        nd, outputs = into.shape
        self._places: list[LearnedErrors] = []
        self._root = np.zeros((predictions, outputs, 0, 0))
        self._carried = np.zeros((predictions, nd, outputs, 0))
        self._now = np.zeros((predictions, outputs, 0))

    def arrive(self, errors: LearnedErrors) -> None:
        """At the next place of the path, of the push with these `errors`."""
        own = errors.together([errors], open_only=self._open_only)[0]
        both = errors.together(self._places, open_only=self._open_only)
        row, left = np.zeros((*own.shape, len(self._places))), own
        for k in range(len(self._places)):
            known = np.einsum("mjk,mjk->mj", row[..., :k], self._root[..., k, :k])
            # Where support leaves little open, rounding alone could tell more than there is.
            most = np.sqrt(np.maximum(left, 0.0))
            row[..., k] = np.clip((both[k] - known) / self._root[..., k, k], -most, most)
            left = left - row[..., k] ** 2
        told = (row**2).sum(axis=-1)
        # Of a craft that cannot be, one error may be no number, or larger than all others together.
        fresh, there = np.fmax(left, 0.0), own > 0.0
        share = np.divide(fresh, own, out=np.zeros_like(own), where=there)
        if np.any(share.sum(axis=0) > SAME * len(own)) or np.any(there & (told == 0.0)):
            least = np.where(there, LEAST * own, 1.0)
            row = np.concatenate([row, np.sqrt(np.maximum(fresh, least))[..., None]], axis=-1)
            self._add(errors, row)
        else:
            row = (
                row * np.sqrt(np.divide(own, told, out=np.zeros_like(own), where=there))[..., None]
            )
        self._now = row * there[..., None]

    def _add(self, errors: LearnedErrors, row: FloatArray) -> None:
        self._places.append(errors)
        r = len(self._places)
        root = np.zeros((*row.shape[:2], r, r))
        root[..., : r - 1, : r - 1] = self._root
        root[..., r - 1, :] = row
        self._root = root
        self._carried = np.concatenate(
            [self._carried, np.zeros((*self._carried.shape[:3], 1))], axis=-1
        )

    @property
    def carried(self) -> FloatArray:
        """What the error made of the error state so far, (m, n_d, n_out r)."""
        return _in_columns(self._carried)

    def seen(self, through: FloatArray) -> FloatArray:
        """What it makes of a measurement at this place by itself, (m, n_e, n_out r), where it acts
        on it by `through` (n_e, n_out)."""
        return _in_columns(through[None, :, :, None] * self._now[:, None])

    def step(self, a: FloatArray) -> None:
        """One sample on, by the transitions a (m, n_d, n_d) of the error state."""
        moved = (a @ self.carried).reshape(self._carried.shape)
        self._carried = moved + self._into[None, :, :, None] * self._now[:, None]


def _in_columns(array: FloatArray) -> FloatArray:
    """(m, n, n_out, r) as (m, n, n_out r)."""
    m, n, outputs, r = array.shape
    return array.reshape(m, n, outputs * r)
