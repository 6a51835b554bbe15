"""Covariance of an estimate: Fisher, sandwich for coloured innovations, and what an active bound
leaves of them.

Fisher: the inverse of the Gauss-Newton Hessian (with priors). Sandwich: H^-1 (sum g_b g_b' + P)
H^-1 with the scores g_b of blocks longer than the correlation of the innovations and the prior
precision P (White 1982, Econometrica 50(1); Newey and West 1987). An unknown at an active bound has
no two-sided error: it is held, and the others are conditional on it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from greybox.symbolic import BoolArray, FloatArray

NULL_SHARE = 1e-10
"""Eigenvalues of the scaled information below this share of the largest count as no information."""
FEWEST_BLOCKS = 8
"""Scores of fewer blocks scatter too little, or too much, to tell errors by."""


@dataclass(frozen=True, kw_only=True)
class Covariance:
    """Matrices over all unknowns (n, n); rows and columns of held ones are zero. `matrix`, which
    NumPy takes it for, is the one that errors go by. `coloured`: whether the innovations are.
    `blocks`: how many scores were summed; `doubt`: why all errors are too small, `form`: which
    parameters are no measurement, since flights want what the model lacks, and which pushes go with
    how the craft is flown, `beyond`: which bounds of the model flights push against
    (`greybox.automatic.wanted`), `changed`: where the craft changed within a flight
    (`greybox.automatic.lasting`), `splits`: which noise levels are one number to the flights
    (`greybox.estimation.noise_split`), `more` (n, n): what both matrices have in them from what was
    held and what differs between flights; all empty where nothing says so."""

    fisher: FloatArray
    sandwich: FloatArray
    blocks: int
    doubt: str = ""
    form: str = ""
    beyond: str = ""
    changed: tuple[str, ...] = ()
    splits: tuple[str, ...] = ()
    more: FloatArray | None = None
    coloured: bool = False

    @property
    def matrix(self) -> FloatArray:
        """The covariance (n, n) that errors go by: `chosen` by the colour of the innovations."""
        return self.chosen(self.coloured)

    def __array__(self, dtype: npt.DTypeLike | None = None, copy: bool | None = None) -> FloatArray:
        """`matrix`: numpy.asarray(fit.covariance)."""
        return np.array(self.matrix, dtype=dtype)

    @property
    def enough(self) -> bool:
        """Whether there are blocks enough for the sandwich."""
        return self.blocks >= FEWEST_BLOCKS

    def chosen(self, coloured: bool) -> FloatArray:
        """The sandwich where the innovations are coloured (and there are blocks enough), never
        below Fisher; else Fisher."""
        if not (coloured and self.enough):
            return self.fisher
        more = np.zeros_like(self.fisher) if self.more is None else self.more
        sandwich = self.sandwich - more
        # An unknown that few blocks see (one flight's own) has scores that cancel among them: its
        # sandwich variance is too small, so that no error is reported below Fisher's.
        low, high = np.diag(sandwich), np.diag(self.fisher - more)
        usable = (low > 0) & np.isfinite(low) & np.isfinite(high)
        factor = np.ones(low.size)
        factor[usable] = np.sqrt(np.maximum(high[usable] / low[usable], 1.0))
        return sandwich * np.outer(factor, factor) + more


def covariance(
    hessian: FloatArray, scores: FloatArray | None, precision: FloatArray, held: BoolArray
) -> Covariance:
    """Covariances from the Hessian with priors (n, n), block scores (n_b, n), prior precisions
    (n,), held unknowns (n,).

    Directions without any information (neither data nor prior) get infinite variance on the
    unknowns they touch.
    """
    free = ~np.asarray(held, dtype=bool)
    n = free.size
    fisher, sandwich = np.zeros((n, n)), np.zeros((n, n))
    if free.any():
        inside = np.ix_(free, free)
        inverse, empty = scaled_inverse(hessian[inside])
        meat = np.diag(precision[free])
        if scores is not None:
            part = scores[:, free]
            meat = meat + part.T @ part * (len(part) / max(len(part) - 1, 1))
        fisher[inside] = inverse
        sandwich[inside] = inverse @ meat @ inverse
        places = np.flatnonzero(free)[empty]
        for m in (fisher, sandwich):
            m[places, places] = np.inf
    return Covariance(
        fisher=fisher, sandwich=sandwich, blocks=0 if scores is None else scores.shape[0]
    )


def scaled_eigen(h: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(sizes (n,) of the unknowns, eigenvalues (n,) rising and eigenvectors (n, n) of a positive
    semi-definite matrix whose diagonal they bring to one)."""
    size = np.sqrt(np.maximum(np.diag(h), 1e-300))
    value, vector = np.linalg.eigh(h / np.outer(size, size))
    return size, value, vector


def scaled_inverse(h: FloatArray) -> tuple[FloatArray, BoolArray]:
    """(inverse of a positive semi-definite matrix on its range, mask of unknowns touched by its
    null space).

    Of no unknowns (all of them held) both are empty.
    """
    if not h.size:
        return np.zeros_like(h), np.zeros(0, dtype=bool)
    size, value, vector = scaled_eigen(h)
    least = NULL_SHARE * max(value[-1], 1e-300)
    good = value > least
    known = (vector[:, good] / value[good]) @ vector[:, good].T
    # Known to no more than `least`, the null space would move these further than all else does: its
    # share of an unknown does not say so, for one that is poorly known has a small one.
    unseen = np.square(vector[:, ~good]).sum(axis=1) / least
    inverse, empty = known / np.outer(size, size), np.asarray(unseen > np.diag(known))
    return inverse, empty


def correlation(c: FloatArray) -> FloatArray:
    """Correlation matrix of a covariance; zero where a variance is zero or infinite."""
    size = np.sqrt(np.diag(c))
    usable = np.isfinite(size) & (size > 0)
    out = np.zeros_like(c)
    inside = np.ix_(usable, usable)
    out[inside] = c[inside] / np.outer(size[usable], size[usable])
    np.fill_diagonal(out, 1.0)
    return out
