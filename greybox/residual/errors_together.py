"""How the errors of a learned push at two places go together.

Along a predicted path a vehicle comes to where the function is another one, and its error with it:
for so long as the features stay alike the error is one, later it is fresh. Of a Gaussian process
with numbers as in `GPPosterior` (Rasmussen and Williams 2006, equation 2.24, in its sparse form),

    cov(x, b) = output_scale^2 factor (k(x, b) - (L1 k(x))'(L1 k(b)) + (L2 k(x))'(L2 k(b))),

where the first two terms are what the support leaves open, which no weight can say, and the last
the error of the weights. Of features only the last is there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from greybox.model.layer import LearnedErrors
from greybox.residual.feature_posterior import FeaturePosterior
from greybox.residual.posterior import GPPosterior
from greybox.symbolic import FloatArray, evaluate


@dataclass(frozen=True, kw_only=True, eq=False)
class NoErrors(LearnedErrors):
    """Of a push that is known: nothing, (m, n_out)."""

    shape: tuple[int, int]

    def together(self, others: Sequence[NoErrors], *, open_only: bool = False) -> FloatArray:
        """Zeros (r, m, n_out)."""
        return np.zeros((len(others), *self.shape))


@dataclass(frozen=True, kw_only=True, eq=False)
class FeatureErrors(LearnedErrors):
    """Of weighed features: `roots` (n_out, m, M) in the units of the outputs, zero of those that
    are off."""

    roots: FloatArray

    def together(self, others: Sequence[FeatureErrors], *, open_only: bool = False) -> FloatArray:
        """Covariance (r, m, n_out); nothing is open but the weights."""
        outputs, m, _ = self.roots.shape
        if open_only or not others:
            return np.zeros((len(others), m, outputs))
        product: FloatArray = np.einsum("jmk,rjmk->rmj", self.roots, [o.roots for o in others])
        return product


@dataclass(frozen=True, kw_only=True, eq=False)
class ProcessErrors(LearnedErrors):
    """Of a Gaussian process at standardised inputs x (n_in, m): what the support explains, and how
    much of that is uncertain, per active output (M, m)."""

    posterior: GPPosterior
    x: FloatArray
    explained: dict[int, FloatArray]
    uncertain: dict[int, FloatArray]

    def together(self, others: Sequence[ProcessErrors], *, open_only: bool = False) -> FloatArray:
        """Covariance (r, m, n_out); zero of outputs that are off."""
        post, r, m = self.posterior, len(others), self.x.shape[1]
        out, prior = np.zeros((r, m, len(post.outputs))), {}
        if not others:
            return out
        here, there = np.tile(self.x, r), np.concatenate([o.x for o in others], axis=1)
        same = [o is self for o in others]
        for j, own in self.explained.items():
            kernel = post.kernels[j]
            if id(kernel) not in prior:
                prior[id(kernel)] = kernel.paired(here, there).reshape(r, m)
            left = prior[id(kernel)] - _products(own, [o.explained[j] for o in others])
            left[same] = np.maximum(left[same], 0.0)
            if not open_only:
                left += _products(self.uncertain[j], [o.uncertain[j] for o in others])
            out[:, :, j] = post.output_scale[j] ** 2 * post.variance_factor[j] * left
        return out


def _products(own: FloatArray, others: Sequence[FloatArray]) -> FloatArray:
    """Of columns (M, m) with those of each of r others, (r, m)."""
    return np.array([(own * other).sum(axis=0) for other in others])


def errors_at(posterior: GPPosterior | FeaturePosterior, z: FloatArray) -> LearnedErrors:
    """The errors of a learned part at features z (m, n_in)."""
    x = (z - posterior.input_mean) / posterior.input_scale
    active = [j for j, on in enumerate(posterior.active) if on]
    if isinstance(posterior, FeaturePosterior):
        phi = evaluate(posterior.phi, np.ascontiguousarray(x))
        roots = np.zeros((len(posterior.outputs), *phi.shape))
        for j in active:
            roots[j] = posterior.output_scale[j] * (phi @ posterior.root[j].T)
        return FeatureErrors(roots=roots)
    covariance = {}
    for j in active:
        kernel = posterior.kernels[j]
        if id(kernel) not in covariance:
            covariance[id(kernel)] = kernel.covariance(posterior.support.T, x.T)
    of = {j: covariance[id(posterior.kernels[j])] for j in active}
    return ProcessErrors(
        posterior=posterior,
        x=np.ascontiguousarray(x.T),
        explained={j: posterior.explained[j] @ k for j, k in of.items()},
        uncertain={j: posterior.uncertain[j] @ k for j, k in of.items()},
    )
