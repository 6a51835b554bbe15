"""Error measures of predictions against measurements, with missing samples masked and counted.

Definitions. With e = y - y_hat over n samples of d components: MSE = mean(e^2), RMSE = sqrt(MSE);
R^2 = 1 - sum(e^2) / sum((y - mean y)^2), sums over samples and components with a mean per
component; fit = 100 (1 - |e| / |y - mean y|), the NRMSE fit of L. Ljung, "System Identification:
Theory for the User", 2nd ed., 1999; VAF = 100 (1 - var(e) / var(y)), which a constant offset does
not lower. The mean absolute error of a vector is the mean of its Euclidean norm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypedDict

import numpy as np
import numpy.typing as npt

from greybox.errors import DataError
from greybox.symbolic import FloatArray
from greybox.validation.samples import pairs

ArrayLike = npt.ArrayLike


def mse(measured: ArrayLike, predicted: ArrayLike, *, mask: ArrayLike | None = None) -> float:
    """Mean squared error over samples and components [unit^2]; arrays (N,) or (N, d). Raises
    `DataError`."""
    y, p, _ = pairs(measured, predicted, mask)
    return float(np.mean((y - p) ** 2))


def rmse(measured: ArrayLike, predicted: ArrayLike, *, mask: ArrayLike | None = None) -> float:
    """Root of `mse` [unit]."""
    return math.sqrt(mse(measured, predicted, mask=mask))


def norm_errors(
    measured: ArrayLike, predicted: ArrayLike, *, mask: ArrayLike | None = None
) -> FloatArray:
    """Euclidean norm of the error of every compared sample, (n,) [unit]; arrays (N,) or (N, d).
    Raises `DataError`."""
    y, p, _ = pairs(measured, predicted, mask)
    norms: FloatArray = np.linalg.norm(y - p, axis=1)
    return norms


def mae(measured: ArrayLike, predicted: ArrayLike, *, mask: ArrayLike | None = None) -> float:
    """Mean of the Euclidean norm of the error [unit]; for one column the mean absolute error.
    Raises `DataError`."""
    return float(norm_errors(measured, predicted, mask=mask).mean())


def _spread(y: FloatArray) -> float:
    """Sum of squares about the mean of each component; `DataError` where the measurement does not
    move at all."""
    total = float(np.sum((y - y.mean(axis=0)) ** 2))
    floor = np.finfo(np.float64).eps ** 2 * float(np.sum(y * y))
    if not total > 4.0 * floor * len(y):
        raise DataError(
            "the measurement is constant, so that R^2, fit and VAF are undefined",
            fix="use RMSE, or a stretch in which the channel moves",
        )
    return total


def r_squared(measured: ArrayLike, predicted: ArrayLike, *, mask: ArrayLike | None = None) -> float:
    """Coefficient of determination R^2 [-], 1 = perfect, 0 = as good as the mean, negative = worse
    than the mean.

    Raises `DataError` where the measurement is constant.
    """
    y, p, _ = pairs(measured, predicted, mask)
    return 1.0 - float(np.sum((y - p) ** 2)) / _spread(y)


def fit_percentage(
    measured: ArrayLike, predicted: ArrayLike, *, mask: ArrayLike | None = None
) -> float:
    """NRMSE fit [%]: 100 (1 - sqrt(1 - R^2)). Raises `DataError` where the measurement is
    constant."""
    return 100.0 * (1.0 - math.sqrt(max(0.0, 1.0 - r_squared(measured, predicted, mask=mask))))


def vaf(measured: ArrayLike, predicted: ArrayLike, *, mask: ArrayLike | None = None) -> float:
    """Variance accounted for [%]; blind to a constant offset. Raises `DataError` where the
    measurement is constant."""
    y, p, _ = pairs(measured, predicted, mask)
    error = y - p
    return 100.0 * (1.0 - float(np.sum((error - error.mean(axis=0)) ** 2)) / _spread(y))


class MetricsRow(TypedDict):
    """A `ChannelMetrics` in a result file."""

    n: int
    missing: int
    unit: str
    mse: float
    rmse: float
    mae: float
    bias: float
    r2: float | None
    fit: float | None
    vaf: float | None


@dataclass(frozen=True, kw_only=True)
class ChannelMetrics:
    """All error measures of one channel (or of one vector of channels). `r2`, `fit`, `vaf` are None
    for a constant one.

    `n` samples were compared, `missing` were left out; `mse` in unit^2, `rmse`, `mae` and `bias`
    (the norm of the mean error) in `unit`, `fit` and `vaf` in percent.
    """

    n: int
    missing: int
    unit: str
    mse: float
    rmse: float
    mae: float
    bias: float
    r2: float | None
    fit: float | None
    vaf: float | None

    def to_dict(self) -> MetricsRow:
        """Plain values under the names of the fields."""
        return {
            "n": self.n,
            "missing": self.missing,
            "unit": self.unit,
            "mse": self.mse,
            "rmse": self.rmse,
            "mae": self.mae,
            "bias": self.bias,
            "r2": self.r2,
            "fit": self.fit,
            "vaf": self.vaf,
        }


def channel_metrics(
    measured: ArrayLike, predicted: ArrayLike, *, unit: str = "", mask: ArrayLike | None = None
) -> ChannelMetrics:
    """All measures at once for arrays (N,) or (N, d). Raises `DataError` as `pairs` does."""
    y, p, missing = pairs(measured, predicted, mask)
    error = y - p
    square = float(np.mean(error**2))
    try:
        r2: float | None = r_squared(y, p)
        fit: float | None = fit_percentage(y, p)
        accounted: float | None = vaf(y, p)
    except DataError:
        r2 = fit = accounted = None
    return ChannelMetrics(
        n=len(y),
        missing=missing,
        unit=unit,
        mse=square,
        rmse=math.sqrt(square),
        mae=float(np.linalg.norm(error, axis=1).mean()),
        bias=float(np.linalg.norm(error.mean(axis=0))),
        r2=r2,
        fit=fit,
        vaf=accounted,
    )
