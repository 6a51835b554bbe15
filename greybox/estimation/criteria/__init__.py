"""Criteria: one file is one member; `CRITERIA` maps names to them."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from greybox.estimation.criteria.gaussian import Gaussian
from greybox.estimation.criteria.least_squares import LeastSquares
from greybox.estimation.criteria.robust import Robust
from greybox.estimation.criterion import Criterion

CRITERIA: Mapping[str, Callable[..., Criterion]] = {
    "gaussian": Gaussian,
    "least-squares": LeastSquares,
    "robust": Robust,
}
