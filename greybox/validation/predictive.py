"""Scores of a Gaussian prediction, mean and variance per sample: NLPD, CRPS, coverage, PIT,
sharpness.

Gneiting and Raftery 2007, Strictly proper scoring rules, prediction and estimation, JASA 102(477);
Gneiting, Balabdaoui and Raftery 2007, Probabilistic forecasts, calibration and sharpness, JRSS B
69(2). Samples that are not measured (NaN) are left out of every score.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypedDict

import numpy as np
import numpy.typing as npt
import scipy.special

from greybox.errors import DataError
from greybox.statistics.distributions import normal_quantile
from greybox.symbolic import FloatArray

LEVELS = (0.50, 0.68, 0.95)
"""The levels at which the coverage of predictions is stated."""


def _seen(
    y: npt.ArrayLike, mean: npt.ArrayLike, variance: npt.ArrayLike
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Measured samples: (error, variance, standardised error), flat."""
    value = np.asarray(y, dtype=np.float64)
    m, v = (np.broadcast_to(np.asarray(a, dtype=np.float64), value.shape) for a in (mean, variance))
    there = np.isfinite(value)
    if not there.any():
        raise DataError("no measured sample to score a prediction on")
    m, v = m[there], v[there]
    if not (np.isfinite(m).all() and np.isfinite(v).all() and np.all(v > 0)):
        raise DataError("a predicted mean or variance is not finite, or a variance is not positive")
    error = value[there] - m
    return error, v, error / np.sqrt(v)


def nlpd(y: npt.ArrayLike, mean: npt.ArrayLike, variance: npt.ArrayLike) -> float:
    """Mean negative log predictive density [nat per sample], log N(y; mean, variance)."""
    _, v, z = _seen(y, mean, variance)
    return float(np.mean(0.5 * np.log(2 * np.pi * v) + 0.5 * z * z))


def crps(y: npt.ArrayLike, mean: npt.ArrayLike, variance: npt.ArrayLike) -> float:
    """Mean continuous ranked probability score, unit of y (Gneiting and Raftery 2007, eq. 21)."""
    _, v, z = _seen(y, mean, variance)
    density = np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi)
    return float(
        np.mean(
            np.sqrt(v) * (z * (2 * scipy.special.ndtr(z) - 1) + 2 * density - 1 / np.sqrt(np.pi))
        )
    )


def coverage(y: npt.ArrayLike, mean: npt.ArrayLike, variance: npt.ArrayLike, level: float) -> float:
    """Share of the samples inside the central interval of probability `level`."""
    _, _, z = _seen(y, mean, variance)
    return float(np.mean(np.abs(z) <= normal_quantile(0.5 + level / 2)))


def sharpness(y: npt.ArrayLike, mean: npt.ArrayLike, variance: npt.ArrayLike) -> float:
    """Mean predicted standard deviation over the measured samples, unit of y."""
    return float(np.mean(np.sqrt(_seen(y, mean, variance)[1])))


def pit(
    y: npt.ArrayLike, mean: npt.ArrayLike, variance: npt.ArrayLike, *, bins: int = 20
) -> FloatArray:
    """Histogram (bins,) of the probability integral transform; a calibrated prediction has 1/bins
    everywhere."""
    _, _, z = _seen(y, mean, variance)
    counts = np.histogram(scipy.special.ndtr(z), bins=bins, range=(0.0, 1.0))[0]
    return np.asarray(counts / counts.sum(), dtype=np.float64)


class ScoresDocument(TypedDict):
    """Scores of one channel in a result file."""

    n: int
    mse: float
    nlpd: float
    crps: float
    sharpness: float
    coverage50: float
    coverage68: float
    coverage95: float
    pit: list[float]


@dataclass(frozen=True, kw_only=True, eq=False)
class Scores:
    """All scores of one channel. `coverage` maps the levels of `LEVELS` to shares; `pit` is a
    histogram (20,)."""

    n: int
    mse: float
    nlpd: float
    crps: float
    sharpness: float
    coverage: Mapping[float, float]
    pit: FloatArray

    def to_dict(self) -> ScoresDocument:
        """Plain values; coverage50, coverage68, coverage95 as in the result files."""
        half, most, nearly_all = (self.coverage[level] for level in LEVELS)
        return {
            "n": self.n,
            "mse": self.mse,
            "nlpd": self.nlpd,
            "crps": self.crps,
            "sharpness": self.sharpness,
            "coverage50": half,
            "coverage68": most,
            "coverage95": nearly_all,
            "pit": self.pit.tolist(),
        }


def score(y: npt.ArrayLike, mean: npt.ArrayLike, variance: npt.ArrayLike) -> Scores:
    """All scores of predictions of one channel; arrays of one shape. Raises `DataError` where
    nothing was measured."""
    error, _, _ = _seen(y, mean, variance)
    return Scores(
        n=len(error),
        mse=float(np.mean(error * error)),
        nlpd=nlpd(y, mean, variance),
        crps=crps(y, mean, variance),
        sharpness=sharpness(y, mean, variance),
        coverage={level: coverage(y, mean, variance, level) for level in LEVELS},
        pit=pit(y, mean, variance),
    )


def gaussian_nlpd(errors: FloatArray, covariance: FloatArray) -> FloatArray:
    """-log N(error; 0, covariance) [nat], (...,), of error vectors (..., d) with covariances (...,
    d, d).

    Raises `DataError` where a covariance is not positive definite.
    """
    try:
        root = np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        raise DataError(
            "a predicted covariance is not positive definite", fix="check the noise levels"
        ) from None
    white = np.linalg.solve(root, errors[..., None])[..., 0]
    logdet = 2 * np.log(np.diagonal(root, axis1=-2, axis2=-1)).sum(axis=-1)
    return np.asarray(
        0.5 * (np.sum(white * white, axis=-1) + logdet + errors.shape[-1] * np.log(2 * np.pi))
    )
