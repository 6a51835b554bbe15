"""Between two readings of the same columns: how far the data stand on the way from one to the
other.

Two readings predict the same motion y by x and by x + d (body or world axes, say). Where the craft
stays nearly level and at one heading d is small, so that both explain about as much of y, and
comparing these shares says nothing. But y = M x + w d, with any constant matrix M, holds with w = 0
where the first reading is true and with w = 1 where the second is: mounting, factors and axes go
into M, and what is left of d is what no constant matrix makes of x. The partial regression of
Frisch and Waugh (Econometrica 1(4), 1933) gives w without solving for M.

Sound sensors leave a part of the motion unexplained, and it is no white noise: levers, filters and
clocks follow the motion. Where what is left of d is smaller than that, w weighs them and not the
readings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from greybox.data.checks.signals import FloatArray

LEAST = 1e-9
"""A share of d below which M x explains all of it: rounding."""
FLOOR = 5e-4
"""The share of the motion that sound sensors leave unexplained: readings that differ by less are
one."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Mixture:
    """Sums over blocks of time (B, 3, 3): x x^T, x d^T, d d^T, x y^T and d y^T."""

    xx: FloatArray
    xd: FloatArray
    dd: FloatArray
    xy: FloatArray
    dy: FloatArray

    def weights(self) -> tuple[float, FloatArray]:
        """Weight w of the second reading, and the weights (B,) with one block left out each; w
        is NaN where the readings differ by a constant matrix alone, or by less than sensors
        resolve."""
        every = [np.asarray(m.sum(axis=0)) for m in (self.xx, self.xd, self.dd, self.xy, self.dy)]
        blocks = (self.xx, self.xd, self.dd, self.xy, self.dy)
        others = [total - part for total, part in zip(every, blocks, strict=True)]
        return float(_weight([m[None] for m in every])[0]), _weight(others)


def mixture(
    y: FloatArray, x: FloatArray, other: FloatArray, starts: npt.NDArray[np.int64]
) -> Mixture:
    """Sums of rows of y, x and the other reading's x, (N, 3) each; `starts` (B,) are the blocks'
    first rows."""
    d = other - x
    xx, xd, dd = (products(a, b, starts) for a, b in ((x, x), (x, d), (d, d)))
    return Mixture(xx=xx, xd=xd, dd=dd, xy=products(x, y, starts), dy=products(d, y, starts))


def products(a: FloatArray, b: FloatArray, starts: npt.NDArray[np.int64]) -> FloatArray:
    """Sums of a b^T (B, 3, 3) over blocks of rows (N, 3) that begin at `starts` (B,)."""
    # By columns: what is summed is in one piece, and three times as fast.
    left, right = (np.ascontiguousarray(v.T) for v in (a, b))
    return np.add.reduceat(left[:, None] * right[None], starts, axis=2).transpose(2, 0, 1)


def joined(parts: Sequence[Mixture]) -> Mixture:
    """The blocks of several flights together."""
    return Mixture(
        xx=np.concatenate([p.xx for p in parts]),
        xd=np.concatenate([p.xd for p in parts]),
        dd=np.concatenate([p.dd for p in parts]),
        xy=np.concatenate([p.xy for p in parts]),
        dy=np.concatenate([p.dy for p in parts]),
    )


def _weight(sums: Sequence[FloatArray]) -> FloatArray:
    """w (B,) from sums (B, 3, 3) each."""
    xx, xd, dd, xy, dy = sums
    through = xd.swapaxes(1, 2) @ np.linalg.pinv(xx, hermitian=True)
    left = np.trace(dd - through @ xd, axis1=1, axis2=2)
    told = np.trace(dy - through @ xy, axis1=1, axis2=2)
    size, apart = (np.trace(m, axis1=1, axis2=2) for m in (xx, dd))
    seen = (left > LEAST * apart) & (left > FLOOR * size)
    return np.where(seen, told / np.where(seen, left, 1.0), np.nan)
