"""Normal equations of least squares, block by block, so that any blocks can be left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from greybox.symbolic import FloatArray

RIDGE = 1e-9
"""Added to the diagonal of scaled normal equations: columns may be the same."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Normal:
    """Normal equations of a least squares problem, one block per stretch of flight: X'X (s, t, t),
    X'y (s, t), y'y (s,); `flights` (s,) tells which flight a stretch belongs to."""

    xx: FloatArray
    xy: FloatArray
    yy: FloatArray
    flights: tuple[str, ...]

    @staticmethod
    def of(x: Sequence[FloatArray], y: Sequence[FloatArray], flights: Sequence[str]) -> Normal:
        """From the rows of every stretch, (n, t) and (n,)."""
        return Normal(
            xx=np.array([a.T @ a for a in x]),
            xy=np.array([a.T @ b for a, b in zip(x, y, strict=True)]),
            yy=np.array([b @ b for b in y]),
            flights=tuple(flights),
        )

    @staticmethod
    def joined(
        blocks: Sequence[Normal], flights: Sequence[str], xx: FloatArray | None = None
    ) -> Normal:
        """Single blocks one after the other; `xx` where it is known already."""
        xy, yy = (np.concatenate([getattr(b, n) for b in blocks]) for n in ("xy", "yy"))
        whole = np.concatenate([b.xx for b in blocks]) if xx is None else xx
        return Normal(xx=whole, xy=xy, yy=yy, flights=tuple(flights))

    def __add__(self, other: Normal) -> Normal:
        """The rows of both, block by block."""
        return replace(self, xx=self.xx + other.xx, xy=self.xy + other.xy, yy=self.yy + other.yy)

    def plus(self, first: int, c: FloatArray) -> Normal:
        """Of y + X_c c, where X_c are the columns from `first` on."""
        some = slice(first, first + len(c))
        added = self.xx[:, :, some] @ c
        yy = self.yy + (2 * self.xy[:, some] + added[:, some]) @ c
        return replace(self, xy=self.xy + added, yy=yy)

    def believing(self, column: int, coefficient: float, sigma: float) -> Normal:
        """With a prior about the coefficient of one column, spread over all blocks."""
        xx, xy, weight = self.xx.copy(), self.xy.copy(), sigma**-2 / len(self.yy)
        xx[:, column, column] += weight
        xy[:, column] += weight * coefficient
        return replace(self, xx=xx, xy=xy, yy=self.yy + weight * coefficient**2)


def solve(xx: FloatArray, xy: FloatArray, columns: Sequence[int]) -> FloatArray:
    """Coefficients of some columns."""
    c = list(columns)
    scale = 1 / np.sqrt(np.maximum(np.diag(xx)[c], 1e-300))
    m = xx[np.ix_(c, c)] * scale[:, None] * scale
    return np.asarray(
        scale * np.linalg.lstsq(m + RIDGE * np.eye(len(c)), scale * xy[c], rcond=None)[0]
    )
