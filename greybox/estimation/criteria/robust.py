"""Robust loss on whitened residuals: cost = sum rho(z) + 1/2 log det S, z = L^-1 e with S = L L'.

    student-t:     rho(z) = a (nu + 1)/2 log(1 + z^2/nu)      (Lange, Little and Taylor 1989, JASA 84(408))
    pseudo-huber:  rho(z) = a delta^2 (sqrt(1 + (z/delta)^2) - 1)   (Hartley and Zisserman 2003, appendix 6.8)

The factor a makes E[z rho'(z)] = 1 for a standard normal z, so that noise levels are those of the
Gaussian criterion on clean data (Huber 1981, Robust Statistics, ch. 6 and 8). The Hessian is that
of iteratively reweighted least squares. What the loss does not undo: an outlier that the
predictor's gain has let into its state.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Literal

import numpy as np

from greybox.errors import ModelError
from greybox.estimation.criteria.gaussian import Gaussian
from greybox.estimation.predictor import Block
from greybox.symbolic import FloatArray


@dataclass(frozen=True, kw_only=True)
class Robust(Gaussian):
    """Maximum likelihood with heavy tails. `shape` is nu (student-t) or delta (pseudo-huber), in
    standard deviations."""

    kind: Literal["student-t", "pseudo-huber"] = "student-t"
    shape: float = 4.0
    name: str = "robust"

    def __post_init__(self) -> None:
        if self.kind not in ("student-t", "pseudo-huber"):
            raise ModelError(
                f"unknown robust loss '{self.kind}'", expected="student-t or pseudo-huber"
            )
        if not self.shape > 0:
            raise ModelError("the shape of a robust loss must be positive", got=f"{self.shape:g}")

    def loss(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(rho(z), rho'(z)/z)."""
        return _loss(self.kind, self.shape, _factor(self.kind, self.shape), z)

    def variances(self, blocks: list[Block]) -> FloatArray:
        """Concentrated scale per channel: the sigma^2 with mean of z rho'(z) = 1 (a missing cell
        has e = 0)."""
        e = np.concatenate([b.e for b in blocks])
        there = np.concatenate([b.mask for b in blocks]) != 0
        out = np.ones(e.shape[1])
        for i in range(out.size):
            seen = e[there[:, i], i]
            if seen.size:
                out[i] = self._scale(seen)
        return out

    def _scale(self, e: FloatArray) -> float:
        """Fixed point sigma^2 = mean of weight * e^2, from the median absolute value."""
        variance = max(
            float(np.median(np.abs(e)) / 0.6745) ** 2, 1e-12 * float(np.mean(e * e)), 1e-300
        )
        for _ in range(200):
            z = e / np.sqrt(variance)
            ratio = float(np.mean(self.loss(z)[1] * z * z))
            if not ratio > 0:
                break
            variance *= ratio
            if abs(ratio - 1) < 1e-13:
                break
        return variance


def _loss(kind: str, shape: float, factor: float, z: FloatArray) -> tuple[FloatArray, FloatArray]:
    if kind == "student-t":
        u = 1.0 + z * z / shape
        return factor * 0.5 * (shape + 1) * np.log(u), factor * (shape + 1) / (shape * u)
    root = np.sqrt(1.0 + (z / shape) ** 2)
    return factor * shape * shape * (root - 1.0), factor / root


@functools.cache
def _factor(kind: str, shape: float) -> float:
    """1 / E[z rho'(z)] for a standard normal z, by the trapezoidal rule (exact to rounding for such
    integrands)."""
    z = np.linspace(-12.0, 12.0, 4801)
    density = np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi)
    _, weight = _loss(kind, shape, 1.0, z)
    return float(1.0 / ((weight * z * z * density).sum() * (z[1] - z[0])))
