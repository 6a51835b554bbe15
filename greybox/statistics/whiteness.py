"""Portmanteau tests: are records without correlation in time?

Per channel: G. M. Ljung and G. E. P. Box, "On a measure of lack of fit in time series models",
Biometrika 65(2), 1978; with gaps every lag enters with its own number of pairs, after D. S. Stoffer
and C. M. C. Toloi, Statistics and Probability Letters 13, 1992. All channels together: J. R. M.
Hosking, "The multivariate portmanteau statistic", J. American Statistical Association 75, 1980.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypedDict

import numpy as np

from greybox.errors import DataError
from greybox.statistics.correlation import centred, lagged
from greybox.statistics.distributions import chi_square_tail, kolmogorov_quantile
from greybox.symbolic import FloatArray


class PortmanteauRow(TypedDict):
    """A `Portmanteau` in a result file."""

    q: float
    dof: int
    p_value: float
    n: int


@dataclass(frozen=True, kw_only=True)
class Portmanteau:
    """A portmanteau test: statistic `q`, degrees of freedom `dof`, probability `p_value` of that
    much if white, and the number of samples `n`."""

    q: float
    dof: int
    p_value: float
    n: int

    def to_dict(self) -> PortmanteauRow:
        """Plain values under the names of the fields."""
        return {"q": self.q, "dof": self.dof, "p_value": self.p_value, "n": self.n}


@dataclass(frozen=True, kw_only=True)
class Autocorrelation:
    """Of one channel: `r` (max_lag,) at lags 1.., each a mean over its own `pairs` (max_lag,) of
    samples divided by the `variance` of all `n` samples; 0 where nothing moves."""

    r: FloatArray
    pairs: FloatArray
    variance: float
    n: int


def autocorrelation(
    columns: Sequence[FloatArray],
    max_lag: int,
    *,
    each: bool = False,
) -> Autocorrelation:
    """Autocorrelation of one channel given as records (N_i, 1), NaN = missing.

    Pairs never reach from one record into the next. `each=True` takes the mean out of every record
    and gives back what that takes from the correlations of white noise, else one mean of all
    records is used.
    """
    values, weights = centred(columns, each=each)
    c, count = lagged(values, weights, values, weights, range(max_lag + 1))
    variance, pairs = float(c[0, 0, 0]), count[1:, 0, 0]
    r = c[1:, 0, 0] / variance if variance > 0 else np.zeros(max_lag)
    if each and variance > 0:
        # White samples minus their mean are correlated by -1 / N_i: many short records would all
        # look coloured.
        shares = [w / max(float(w.sum()), 1.0) for w in weights]
        _, lost = lagged(values, weights, values, shares, range(1, max_lag + 1))
        r = r + lost[:, 0, 0] / np.maximum(pairs, 1.0)
    return Autocorrelation(r=r, pairs=pairs, variance=variance, n=int(count[0, 0, 0]))


PERIODOGRAM_POINTS = 51
"""Frequencies at which a cumulated periodogram is given: as many as a figure shows."""


def cumulated_periodogram(
    columns: Sequence[FloatArray], *, level: float = 0.95
) -> tuple[FloatArray, float]:
    """(share (PERIODOGRAM_POINTS,) of the variance below the frequencies from 0 to half the sample
    rate, half-width of the band in which the whole curve of white noise stays with probability
    `level`) of one channel.

    `columns` are records (N_i, 1), NaN = missing: those count as the mean, which leaves white noise
    white. The curve of white noise is a straight line, with the band of Kolmogorov and Smirnov (G.
    E. P. Box and G. M. Jenkins, Time Series Analysis, 1976, section 8.2.5). Zeros where nothing
    varies.
    """
    values, _ = centred(columns, each=False)
    grid = np.linspace(0.0, 0.5, PERIODOGRAM_POINTS)
    share, pieces, ordinates = np.zeros(PERIODOGRAM_POINTS), 0.0, 0
    for v in values:
        power = np.abs(np.fft.rfft(v[:, 0]))[1:] ** 2
        if len(v) % 2 == 0:
            power[-1:] /= 2.0  # the highest frequency has no mirror image
        frequencies = np.arange(1, len(power) + 1) / len(v)
        share += np.interp(
            grid, np.append(0.0, frequencies), np.append(0.0, np.cumsum(power))
        ) / len(v)
        pieces += float(power.sum()) / len(v)
        ordinates += len(power)
    if not pieces > 0:
        return share, float("inf")
    return share / pieces, float(kolmogorov_quantile(level)) / float(np.sqrt(max(ordinates, 1)))


def ljung_box(seen: Autocorrelation, *, fitted: int = 0) -> Portmanteau:
    """Ljung and Box's test of all lags of one channel: Q = n (n + 2) sum_k r_k^2 / (n - k) where no
    sample is missing.

    `fitted` parameters of the channel's dynamics are taken off the degrees of freedom. Raises
    `DataError` where none is left.
    """
    # With r_k a mean over its own pairs, pairs r_k^2 (n + 2) / n is the same and holds with gaps.
    q = float(np.sum(seen.pairs * seen.r * seen.r)) * (seen.n + 2.0) / seen.n
    return _test(q, _degrees(len(seen.r), fitted), seen.n)


def hosking(records: Sequence[FloatArray], max_lag: int, *, fitted: int = 0) -> Portmanteau | None:
    """Hosking's test of all channels of records (N_i, d) together; None for fewer than 4 max_lag d
    complete samples.

    Samples with a missing channel are left out; one mean of all records is removed. `fitted` is
    taken off the d^2 max_lag degrees of freedom. Raises `DataError` where none is left or where
    channels are copies of each other.
    """
    d = records[0].shape[1]
    rows = [np.where(np.isfinite(r).all(axis=1, keepdims=True), r, np.nan) for r in records]
    n = int(sum(np.isfinite(r[:, 0]).sum() for r in rows))
    if n < 4 * max_lag * d:
        return None
    values, weights = centred(rows, each=False)
    at_zero, _ = lagged(values, weights, values, weights, [0])
    try:
        root = np.linalg.cholesky(at_zero[0])
    except np.linalg.LinAlgError:
        what = "whiteness: two innovation components are copies of each other"
        raise DataError(what, fix="leave one out") from None
    white = [np.asarray(np.linalg.solve(root, v.T).T, dtype=np.float64) for v in values]
    c, count = lagged(white, weights, white, weights, range(1, max_lag + 1))
    # Pair counts per lag stand in for n - k: full records give Hosking's n^2 sum tr(..)/(n - k),
    # with n + 2 for n.
    q = float(np.sum(count * c * c)) * (n + 2.0) / n
    return _test(q, _degrees(d * d * max_lag, fitted), n)


def is_coloured(innovations: Sequence[FloatArray], lags: int = 20, level: float = 0.01) -> bool:
    """Whether some channel fails the Ljung-Box test at `level`, Bonferroni over channels.

    `innovations`: records (n, n_e), NaN = missing; the mean of every record is removed. Records of
    up to 3 `lags` samples, channels with fewer than 5 `lags` and channels that do not move are
    passed over.
    """
    usable = [e for e in innovations if e.shape[0] > 3 * lags]
    if not usable:
        return False
    tests = []
    for j in range(usable[0].shape[1]):
        seen = autocorrelation([e[:, j : j + 1] for e in usable], lags, each=True)
        if seen.n >= 5 * lags and seen.variance > 0:
            tests.append(ljung_box(seen).p_value)
    return bool(tests) and min(tests) < level / len(tests)


def _degrees(total: int, fitted: int) -> int:
    if total - fitted < 1:
        raise DataError(
            f"whiteness: {total} correlations leave nothing to test after {fitted} parameters",
            fix="use more lags",
        )
    return total - fitted


def _test(q: float, dof: int, n: int) -> Portmanteau:
    return Portmanteau(q=q, dof=dof, p_value=float(chi_square_tail(q, dof)), n=n)
