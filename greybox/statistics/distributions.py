"""Quantiles and tails of the usual distributions, by `scipy.special`: importing `scipy.stats` for
them takes half a second of every command."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy.special

from greybox.symbolic import FloatArray


def normal_quantile(level: npt.ArrayLike) -> FloatArray:
    """What a standard normal variable stays below with probability `level`."""
    return np.asarray(scipy.special.ndtri(level))


def student_quantile(level: npt.ArrayLike, dof: npt.ArrayLike) -> FloatArray:
    """What Student's t of `dof` degrees of freedom stays below with probability `level`."""
    return np.asarray(scipy.special.stdtrit(dof, level))


def chi_square_quantile(level: npt.ArrayLike, dof: npt.ArrayLike) -> FloatArray:
    """What chi-square of `dof` degrees of freedom stays below with probability `level`."""
    return np.asarray(2.0 * scipy.special.gammaincinv(0.5 * np.asarray(dof), level))


def chi_square_tail(statistic: npt.ArrayLike, dof: npt.ArrayLike) -> FloatArray:
    """P(chi-square of `dof` degrees of freedom > statistic)."""
    return np.asarray(scipy.special.chdtrc(dof, np.maximum(statistic, 0.0)))


def fisher_quantile(level: npt.ArrayLike, above: npt.ArrayLike, below: npt.ArrayLike) -> FloatArray:
    """What F of `above` and `below` degrees of freedom stays below with probability `level`."""
    return np.asarray(scipy.special.fdtri(above, below, level))


def fisher_tail(statistic: npt.ArrayLike, above: npt.ArrayLike, below: npt.ArrayLike) -> FloatArray:
    """P(F of `above` and `below` degrees of freedom > statistic)."""
    return np.asarray(scipy.special.fdtrc(above, below, np.maximum(statistic, 0.0)))


def beta_quantile(level: npt.ArrayLike, a: npt.ArrayLike, b: npt.ArrayLike) -> FloatArray:
    """What a beta variable of shapes a and b stays below with probability `level`."""
    return np.asarray(scipy.special.betaincinv(a, b, level))


def kolmogorov_quantile(level: npt.ArrayLike) -> FloatArray:
    """What Kolmogorov's statistic sqrt(n) D stays below with probability `level`, n large."""
    return np.asarray(scipy.special.kolmogi(1.0 - np.asarray(level)))
