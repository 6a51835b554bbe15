"""Body: which matrices of inertia a body can have.

A body of positive density has second moments of mass that are positive in every direction: every
principal moment of inertia is below half of their sum, which is the triangle inequality and makes J
positive definite (Wensing, Kim and Slotine 2018, IEEE RA-L 3(1), sec. III).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from greybox.symbolic import FloatArray

TRIANGLE_SLACK = 0.05
"""Relative slack of the triangle inequality of what is stated (values come from rounded tables)."""
STATED_SIGMAS = 2.0
"""Stated standard errors of the excess within which a body is possible, as where estimates are
judged."""
SINGULAR = 1e-9
"""Share of the largest element that the smallest principal moment is above."""

PLACES = (
    ("inertia.xx", 0, 0),
    ("inertia.yy", 1, 1),
    ("inertia.zz", 2, 2),
    ("products_of_inertia.Jxy", 0, 1),
    ("products_of_inertia.Jxz", 0, 2),
    ("products_of_inertia.Jyz", 1, 2),
)
"""Parameters that are elements of the inertia matrix, or are added to one. Diagonal elements come
first."""


def margins(inertia: FloatArray) -> FloatArray:
    """Second moments over the trace (3,), the smallest last; positive for every inertia matrix that
    a body can have."""
    trace = float(np.trace(inertia))
    if not np.isfinite(inertia).all() or not trace > 0:
        return np.full(3, -np.inf)
    return np.asarray(0.5 - np.linalg.eigvalsh(inertia) / trace)


def is_possible(inertia: FloatArray) -> bool:
    """Whether a body can have this inertia matrix (3, 3)."""
    return bool(margins(inertia)[-1] > 0)


def may_be_stated(inertia: FloatArray, sigma: Sequence[float] = (0.0, 0.0, 0.0)) -> bool:
    """Whether a body can have this inertia matrix (3, 3), within the rounding of tables and the
    stated standard errors `sigma` of Jxx, Jyy, Jzz."""
    if not np.isfinite(inertia).all():
        return False
    least, middle, most = np.linalg.eigvalsh(inertia)
    if not least > SINGULAR * float(np.abs(inertia).max()):
        return False
    slack = STATED_SIGMAS * math.hypot(*sigma)
    return bool(most <= (least + middle) * (1 + TRIANGLE_SLACK) + slack)
