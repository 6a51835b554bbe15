"""Inside: any learner, believed where its training inputs lie.

Left-out flights of one kind say nothing about flights of another. Beyond the ellipsoid that holds
99 % of the training inputs, of their mean and covariance, features therefore fade as the density of
a Gaussian does, and what they lose in variance before the data one more feature gains, which no
data inform:

    m = (x - middle)' cov(x)^-1 (x - middle),   q = 99 % quantile of m over the training inputs,
    s = exp(-max(m - q, 0)/2),   phi -> (s phi, size (1 - s^2)),   size = rms of |phi| over the rows

The tails of real inputs are longer than those of a Gaussian, and a stray sample is not where a
flight was. Far away the mean is that of the model alone and the variance that of the prior which
the left-out flights chose, as a stationary Gaussian process has it by itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
import numpy.typing as npt

from greybox.residual.learners.learner import Features, Learner, LooksBack, is_centred, is_ensemble
from greybox.symbolic import Expr, FloatArray, evaluate

SHARE = 0.99
"""Of the training inputs, for which features are whole."""
FAR = 1e9
"""An input at which nothing is left, in standard deviations."""
FLAT = 1e-6
"""Least variance of a direction, in that of the widest: a direction that nobody flew is not
free."""


@dataclass(frozen=True)
class Inside:
    """`learner` with features that fade outside of its training inputs."""

    learner: Learner

    @property
    def name(self) -> str:
        """That of the learner."""
        return self.learner.name

    def lags(self, sample_time: float) -> int:
        """As the learner asks for them."""
        return self.learner.lags(sample_time) if isinstance(self.learner, LooksBack) else 0

    @property
    def centred(self) -> bool:
        """As the learner asks for it."""
        return is_centred(self.learner)

    @property
    def ensemble(self) -> bool:
        """As the learner says."""
        return is_ensemble(self.learner)

    def of(self, names: Sequence[str]) -> Inside:
        """That of the learner for inputs of these names."""
        return Inside(self.learner.of(names)) if isinstance(self.learner, LooksBack) else self

    def features(
        self, x: FloatArray, y: FloatArray, *, points: int, seed: int
    ) -> Mapping[str, Features]:
        """Those of the learner, each faded."""
        offered = self.learner.features(x, y, points=points, seed=seed)
        return {label: faded(made, x) for label, made in offered.items()}


def faded(made: Features, x: FloatArray) -> Features:
    """Features that are silent far from the rows x (N, n_in), and one more that is not."""
    middle, n = x.mean(axis=0), x.shape[1]
    values, vectors = np.linalg.eigh(np.cov(x.T).reshape(n, n))
    whitening = (vectors / np.sqrt(np.maximum(values, FLAT * max(float(values.max()), FLAT)))).T
    edge = float(np.quantile(np.sum(((x - middle) @ whitening.T) ** 2, axis=1), SHARE))
    s = ca.SX.sym("x", n)
    own = ca.densify(ca.SX(made(s)))
    if own.size2() != 1 or not own.numel():
        return made  # refused by whoever asked
    size = float(
        np.sqrt(
            np.mean(
                np.sum(
                    evaluate(ca.Function("phi", [s], [own]), np.ascontiguousarray(x)) ** 2, axis=1
                )
            )
        )
    )

    def phi(at: Expr) -> Expr:
        away = ca.sumsqr(ca.DM(whitening) @ (at - ca.DM(middle)))
        near = ca.exp(-0.5 * ca.fmax(away - edge, 0))
        return ca.vertcat(near * made(at), size * (1 - near**2))

    return phi


def seen_share(
    columns: FloatArray, phi: ca.Function, members: int
) -> tuple[FloatArray, npt.NDArray[np.intp]]:
    """(s (N,) of every row, places of the features that no data inform) of faded features phi,
    `columns` (N, M), which stand side by side for the `members` of an ensemble; s is that of the
    first."""
    width = columns.shape[1] // members
    last = np.arange(width - 1, columns.shape[1], width)
    far = evaluate(phi, np.full((1, phi.numel_in(0)), FAR))[0, width - 1]
    return np.sqrt(np.clip(1 - columns[:, width - 1] / far, 0, 1)), last
