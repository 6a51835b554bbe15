"""Scores of one-step predictions over flights: per channel, and as means over channels that may be
averaged.

A mean over rad/s and m/s^2 says nothing: means are over channels in units of their standard
deviation on the training flights. NLPD and CRPS scale accordingly (a density has the unit of one
over the channel).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, TypedDict

import numpy as np
import scipy.stats

from greybox.errors import DataError, GreyboxError
from greybox.linear.spectrum import spectral_error
from greybox.symbolic import FloatArray
from greybox.validation.cross_correlation import cross_correlation
from greybox.validation.metrics import r_squared
from greybox.validation.predictive import ScoresDocument, score
from greybox.validation.whiteness import whiteness

SPACING = 0.1
"""Seconds between the origins of a multi-step table: neighbours tell the same."""

BINS, WIDEST = 16, 4.0
"""Bars of a histogram of errors, and where the outermost end, in root mean squares of the
errors."""
Mean = Literal[
    "mse", "r2", "spectral_error", "nlpd", "crps", "coverage50", "coverage68", "coverage95"
]
MEANS: tuple[Mean, ...] = (
    "mse",
    "r2",
    "spectral_error",
    "nlpd",
    "crps",
    "coverage50",
    "coverage68",
    "coverage95",
)
"""What `one_step_scores` gives as means over channels."""


class ChannelScores(ScoresDocument):
    """Scores of one channel as `one_step_scores` explains them."""

    unit: str
    r2: float
    spectral_error: float
    whiteness: float | None
    input_correlation: float | None
    histogram: list[float]
    sigma_error: float | None
    sigma_manoeuvre: float | None


class StepScores(TypedDict):
    """Scores of every channel, and means over standardised channels."""

    channels: dict[str, ChannelScores]
    mean: dict[str, float]


def one_step_scores(
    measured: Sequence[FloatArray],
    mean: Sequence[FloatArray],
    variance: Sequence[FloatArray],
    inputs: Sequence[FloatArray],
    *,
    names: Sequence[str],
    units: Sequence[str],
    spread: FloatArray,
    dt: float,
) -> StepScores:
    """Scores over stretches: arrays (N_i, n_c) each, NaN in `measured` = missing; `inputs` (N_i,
    n_u); `spread` (n_c,).

    `channels`: name -> mse, r2, spectral_error (share of the signal's power at 0.1-20 Hz that is
    left), nlpd, crps, sharpness, coverage50/68/95, pit, whiteness (share of lags 1-30 outside the
    white band), input_correlation (the largest such share over the inputs, positive lags),
    histogram (shares of errors by their root mean square), sigma_error and sigma_manoeuvre (rank
    correlation of the stated deviation with the size of the error, and with how far the commands
    are from their mean; None where it is constant). `mean`: means of standardised channels. Raises
    `DataError` where a measured sample has no prediction.
    """
    errors = [y - m for y, m in zip(measured, mean, strict=True)]
    for i, name in enumerate(names):
        lost = sum(
            int((np.isfinite(y[:, i]) & ~np.isfinite(m[:, i])).sum())
            for y, m in zip(measured, mean, strict=True)
        )
        if lost:
            raise DataError(f"{name}: {lost} measured samples have no prediction")
    left = spectral_error(errors, list(measured), dt).share
    white, cross = _correlations(errors, inputs, names)
    away = np.concatenate([np.linalg.norm(u - np.nanmean(u, axis=0), axis=1) for u in inputs])
    channels: dict[str, ChannelScores] = {}
    for i, name in enumerate(names):
        y, m, v = (np.concatenate([a[:, i] for a in parts]) for parts in (measured, mean, variance))
        seen = np.isfinite(y)
        channels[name] = {
            "unit": units[i],
            **score(y, m, v).to_dict(),
            "r2": r_squared(y[seen], m[seen]),
            "spectral_error": float(left[i]),
            "whiteness": white.get(name),
            "input_correlation": cross.get(name),
            "histogram": _histogram((y - m)[seen]),
            "sigma_error": _ranked(v[seen], np.abs(y - m)[seen]),
            "sigma_manoeuvre": _ranked(v[seen], away[seen]),
        }
    scale = dict(zip(names, spread, strict=True))
    pooled: dict[str, float] = {
        key: float(np.mean([c[key] for c in channels.values()])) for key in MEANS
    }
    pooled["mse"] = float(np.mean([c["mse"] / scale[n] ** 2 for n, c in channels.items()]))
    pooled["crps"] = float(np.mean([c["crps"] / scale[n] for n, c in channels.items()]))
    pooled["nlpd"] = float(np.mean([c["nlpd"] - np.log(scale[n]) for n, c in channels.items()]))
    return {"channels": channels, "mean": pooled}


def _histogram(e: FloatArray) -> list[float]:
    """Shares (BINS,) of errors (n,) in units of their root mean square; the outermost bars hold all
    that lies beyond."""
    size = float(np.sqrt(np.mean(e**2))) or 1.0
    inside = np.clip(e / size, -WIDEST, WIDEST)
    return [float(v) for v in np.histogram(inside, bins=BINS, range=(-WIDEST, WIDEST))[0] / len(e)]


def _ranked(a: FloatArray, b: FloatArray) -> float | None:
    """Spearman's rank correlation of a (n,) and b (n,); None where one of them does not vary."""
    keep = np.isfinite(a) & np.isfinite(b)
    a, b = a[keep], b[keep]
    if a.size < 3 or np.ptp(a) <= 1e-9 * np.abs(a).max() or np.ptp(b) == 0:
        return None
    return float(scipy.stats.spearmanr(a, b).statistic)


def _correlations(
    errors: Sequence[FloatArray], inputs: Sequence[FloatArray], names: Sequence[str]
) -> tuple[dict[str, float], dict[str, float]]:
    white: dict[str, float] = {}
    cross: dict[str, float] = {}
    try:
        white = {c.name: c.outside for c in whiteness(errors, names=names).channels}
        pairs = cross_correlation(errors, inputs, names=names).pairs
        cross = {
            n: max(p.outside for p in pairs if p.innovation == n)
            for n in {p.innovation for p in pairs}
        }
    except GreyboxError:
        pass  # too short for a test: the scores stand without it
    return white, cross
