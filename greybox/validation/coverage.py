"""Do the stated uncertainties hold? The fraction of errors inside the stated interval, with an
interval of its own.

A vector error is inside at level P where its squared Mahalanobis distance e' C^-1 e is below the P
quantile of chi-square with d degrees of freedom; for one component at 68.27 % and 95.45 % these are
the one- and two-sigma bands.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from greybox.errors import DataError
from greybox.statistics.distributions import beta_quantile, chi_square_quantile
from greybox.symbolic import FloatArray
from greybox.validation.bootstrap import Interval, IntervalRow, block_bootstrap
from greybox.validation.samples import columns

LEVELS = (0.68, 0.95)
"""The levels of coverage that tables and reports show."""


class CoverageRow(IntervalRow):
    """A `Coverage` in a result file."""

    nominal: float
    fraction: float
    n: int
    missing: int
    honest: bool


@dataclass(frozen=True, kw_only=True)
class Coverage:
    """Fraction of `n` errors inside the band that is stated for `nominal`; `interval` is that of
    the fraction."""

    nominal: float
    fraction: float
    n: int
    missing: int
    interval: Interval

    @property
    def honest(self) -> bool:
        """Whether the nominal level lies inside the interval of the fraction."""
        return self.interval.low <= self.nominal <= self.interval.high

    def to_dict(self) -> CoverageRow:
        """Plain values: nominal, fraction, n, missing, low, high, level, method, honest."""
        return {
            "nominal": self.nominal,
            "fraction": self.fraction,
            "n": self.n,
            "missing": self.missing,
            **self.interval.to_dict(),
            "honest": self.honest,
        }


def mahalanobis_squared(errors: npt.ArrayLike, covariance: npt.ArrayLike) -> FloatArray:
    """e' C^-1 e, (N,), of errors (N, d) with covariances (N, d, d) or (d, d); NaN where an error
    component is NaN.

    Raises `DataError` where a covariance is not positive definite.
    """
    e = columns(errors, what="errors")
    c = np.broadcast_to(np.asarray(covariance, dtype=np.float64), (len(e), e.shape[1], e.shape[1]))
    out = np.full(len(e), np.nan)
    seen = np.isfinite(e).all(axis=1)
    try:
        root = np.linalg.cholesky(c[seen])
    except np.linalg.LinAlgError:
        raise DataError(
            "a predicted covariance is not positive definite", fix="check the noise levels"
        ) from None
    white = np.linalg.solve(root, e[seen][..., None])[..., 0]
    out[seen] = np.sum(white * white, axis=1)
    return out


def binomial_interval(inside: int, n: int, level: float = 0.95) -> Interval:
    """Exact interval of a fraction (C. J. Clopper and E. S. Pearson, Biometrika 26, 1934);
    independent samples only.

    Raises `DataError` unless 0 <= inside <= n and n >= 1.
    """
    if not 0 <= inside <= n or n < 1:
        raise DataError(f"no fraction: {inside} of {n}")
    tail = (1.0 - level) / 2.0
    low = 0.0 if inside == 0 else float(beta_quantile(tail, inside, n - inside + 1))
    high = 1.0 if inside == n else float(beta_quantile(1.0 - tail, inside + 1, n - inside))
    return Interval(low=low, high=high, level=level, method="binomial (Clopper-Pearson)")


def coverage_of_distances(
    distances: Sequence[npt.ArrayLike],
    *,
    dimension: int,
    nominal: float = 0.95,
    block: int | None = None,
    level: float = 0.95,
    seed: int = 0,
) -> Coverage:
    """Coverage from squared Mahalanobis distances, one array (N_f,) per flight, NaN = missing.

    Without `block` the interval is binomial (white innovations); with it a block bootstrap
    clustered by flight, which is what correlated errors (multi-step ones, say) need. Raises
    `DataError` where nothing is left.
    """
    if not 0.0 < nominal < 1.0:
        raise DataError(f"coverage level {nominal:g}", expected="between 0 and 1")
    limit = float(chi_square_quantile(nominal, dimension))
    parts = [np.asarray(d, dtype=np.float64).ravel() for d in distances]
    seen = [p[~np.isnan(p)] for p in parts]
    n = sum(len(p) for p in seen)
    if n == 0:
        raise DataError("coverage: no sample is left", fix="check that the channel was logged")
    inside = [(p <= limit).astype(np.float64) for p in seen]
    count = int(sum(p.sum() for p in inside))
    if block is None:
        interval = binomial_interval(count, n, level)
    else:
        interval = block_bootstrap(inside, block=block, level=level, seed=seed)
    missing = sum(len(p) for p in parts) - n
    return Coverage(nominal=nominal, fraction=count / n, n=n, missing=missing, interval=interval)


def interval_coverage(
    errors: Sequence[npt.ArrayLike],
    std: Sequence[npt.ArrayLike] | float,
    *,
    nominal: float = 0.95,
    block: int | None = None,
    level: float = 0.95,
    seed: int = 0,
) -> Coverage:
    """Coverage of scalar errors, one array (N_f,) per flight, with stated standard deviations of
    the same shape.

    `std` may be one number for all. NaN errors are missing and counted. Raises `DataError` for a
    std that is not positive, or where nothing is left; see `coverage_of_distances` for `block`.
    """
    spread = [std] * len(errors) if isinstance(std, (int, float)) else list(std)
    if len(spread) != len(errors):
        raise DataError(f"{len(spread)} arrays of std for {len(errors)} arrays of errors")
    distances = []
    for e, s in zip(errors, spread, strict=True):
        value = np.asarray(e, dtype=np.float64)
        sigma = np.broadcast_to(np.asarray(s, dtype=np.float64), value.shape)
        if not np.all((sigma > 0) | np.isnan(value)):
            raise DataError("a stated standard deviation is not positive")
        distances.append((value / np.where(np.isnan(value), 1.0, sigma)) ** 2)
    return coverage_of_distances(
        distances, dimension=1, nominal=nominal, block=block, level=level, seed=seed
    )
