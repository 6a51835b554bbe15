"""Are the innovations white? Autocorrelation with bands and portmanteau tests.

Innovations of the right model with the right noise are uncorrelated in time. Per channel: G. M.
Ljung and G. E. P. Box, "On a measure of lack of fit in time series models", Biometrika 65, 1978;
with gaps every lag enters with its own number of pairs, after D. S. Stoffer and C. M. C. Toloi,
Statistics and Probability Letters 13, 1992. All channels together: J. R. M. Hosking, "The
multivariate portmanteau statistic", J. American Statistical Association 75, 1980. Fitting makes
innovations whiter than they should be, so that the chi-square loses as many degrees of freedom as
dynamic parameters were fitted.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NotRequired, TypedDict

import numpy as np
import numpy.typing as npt

from greybox.errors import DataError
from greybox.estimation.predictor import Block
from greybox.statistics.correlation import check_lags, predictable_share
from greybox.statistics.distributions import normal_quantile
from greybox.statistics.whiteness import (
    Portmanteau,
    PortmanteauRow,
    autocorrelation,
    cumulated_periodogram,
    hosking,
    ljung_box,
)
from greybox.symbolic import FloatArray
from greybox.validation.samples import names_for, stretches


class ChannelWhitenessRow(PortmanteauRow):
    """A `ChannelWhiteness` in a result file; files of earlier versions have no periodogram and no
    std."""

    missing: int
    mean: float
    std: NotRequired[float]
    r: list[float]
    band: list[float]
    outside: float
    predictable: float
    periodogram: NotRequired[list[float]]
    periodogram_band: NotRequired[float]


class WhitenessDocument(TypedDict):
    """A `Whiteness` in a result file."""

    level: float
    max_lag: int
    fitted: int
    channels: dict[str, ChannelWhitenessRow]
    multivariate: PortmanteauRow | None


@dataclass(frozen=True, kw_only=True)
class ChannelWhiteness:
    """Whiteness of one innovation component.

    `r` (max_lag,) is the autocorrelation at lags 1.., `band` (max_lag,) its half-width if white.
    `outside` is the share of lags outside the band, `periodogram` and `periodogram_band` what
    `cumulated_periodogram` gives, `predictable` the share of variance that the component's own past
    explains, `mean` and `std` those of the component (0 and 1 for normalised innovations of the
    right model).
    """

    name: str
    n: int
    missing: int
    mean: float
    std: float
    r: FloatArray
    band: FloatArray
    outside: float
    predictable: float
    periodogram: FloatArray
    periodogram_band: float
    test: Portmanteau

    def to_dict(self) -> ChannelWhitenessRow:
        """Plain values; the test's fields are on the same level."""
        return {
            "n": self.n,
            "missing": self.missing,
            "mean": self.mean,
            "std": self.std,
            "outside": self.outside,
            "predictable": self.predictable,
            **self.test.to_dict(),
            "r": self.r.tolist(),
            "band": self.band.tolist(),
            "periodogram": self.periodogram.tolist(),
            "periodogram_band": self.periodogram_band,
        }


@dataclass(frozen=True, kw_only=True)
class Whiteness:
    """Whiteness of all innovation components; `multivariate` is None where no sample has all
    components."""

    channels: tuple[ChannelWhiteness, ...]
    multivariate: Portmanteau | None
    max_lag: int
    fitted: int
    level: float

    def to_dict(self) -> WhitenessDocument:
        """Plain values: level, max_lag, fitted, channels {name: ...}, multivariate."""
        return {
            "level": self.level,
            "max_lag": self.max_lag,
            "fitted": self.fitted,
            "channels": {c.name: c.to_dict() for c in self.channels},
            "multivariate": None if self.multivariate is None else self.multivariate.to_dict(),
        }

    def format(self) -> str:
        """A table for the terminal."""
        width = max(len("channel"), *(len(c.name) for c in self.channels))
        head = f"{'n':>7}  {'outside':>7}  {'predictable':>11}  {'Q':>10}  {'dof':>4}  {'p':>8}"
        lines = [f"{'channel':<{width}}  {head}"]
        for c in self.channels:
            lines.append(
                f"{c.name:<{width}}  {c.n:>7d}  {c.outside:>7.0%}  {c.predictable:>11.1%}  "
                f"{c.test.q:>10.1f}  {c.test.dof:>4d}  {c.test.p_value:>8.2g}"
            )
        if self.multivariate is not None:
            m = self.multivariate
            lines.append(
                f"all channels together: Q = {m.q:.1f}, dof = {m.dof}, p = {m.p_value:.2g}, n = "
                f"{m.n}"
            )
        return "\n".join(lines)


def whiteness(
    innovations: Sequence[npt.ArrayLike] | npt.ArrayLike,
    *,
    names: Sequence[str] | None = None,
    max_lag: int = 30,
    fitted: int = 0,
    level: float = 0.95,
) -> Whiteness:
    """Autocorrelation, bands and portmanteau tests of innovations.

    `innovations`: one array (N_i, d) per flight or per stretch without gap, NaN = missing; best
    normalised by their predicted covariance. `fitted` is the number of fitted parameters that shape
    the dynamics of one channel: it is taken off the degrees of freedom of every channel's test, and
    `fitted` times d off the joint test. One mean over all flights is removed, so that an offset
    that differs between flights counts as correlation, as it should. Raises `DataError` for too few
    samples, constant channels, or when no degree of freedom is left.
    """
    records = stretches(innovations, what="innovations")
    d = records[0].shape[1]
    labels = names_for(names, d, what="e")
    check_lags(records, max_lag, what="innovations")
    if fitted < 0 or not 0.0 < level < 1.0:
        raise DataError(
            "whiteness: fitted >= 0 and 0 < level < 1 are needed",
            got=f"fitted={fitted}, level={level:g}",
        )
    z = float(normal_quantile(0.5 + level / 2.0))
    channels = []
    for j, name in enumerate(labels):
        column = [r[:, j : j + 1] for r in records]
        seen = autocorrelation(column, max_lag)
        n, r, pairs = seen.n, seen.r, seen.pairs
        band = np.where(pairs > 0, z / np.sqrt(np.maximum(pairs, 1.0)), np.inf)
        everything = np.concatenate(column)[:, 0]
        share, width = cumulated_periodogram(column, level=level)
        channels.append(
            ChannelWhiteness(
                name=name,
                n=n,
                missing=len(everything) - n,
                mean=float(np.nanmean(everything)),
                std=float(np.nanstd(everything)),
                r=r,
                band=band,
                outside=float(np.mean(np.abs(r) > band)),
                # Weighting by the share of pairs keeps the sequence positive definite for full
                # records.
                predictable=predictable_share(r * pairs / n),
                periodogram=share,
                periodogram_band=width,
                test=ljung_box(seen, fitted=fitted),
            )
        )
    joint = hosking(records, max_lag, fitted=fitted * d) if d > 1 else None
    return Whiteness(
        channels=tuple(channels), multivariate=joint, max_lag=max_lag, fitted=fitted, level=level
    )


def whiteness_of_blocks(
    blocks: Iterable[Block], names: Sequence[str], *, max_lag: int
) -> dict[str, ChannelWhiteness]:
    """Innovation component -> test of its whiteness over all records, of those that can be
    tested."""
    # Lags are at most a quarter of the samples.
    records = [np.where(b.mask != 0, b.e, np.nan) for b in blocks]
    records = [e for e in records if len(e) > 4 * max_lag]
    live = [j for j in range(len(names)) if any(np.isfinite(e[:, j]).any() for e in records)]
    if not live:
        return {}
    test = whiteness([e[:, live] for e in records], names=[names[j] for j in live], max_lag=max_lag)
    return {c.name: c for c in test.channels}
