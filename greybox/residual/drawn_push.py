"""Draws of a learned push: whole functions from its posterior, one per craft, not noise about its
mean.

A learner's features: the push is linear in its weights, which are drawn from their covariance. Of a
Gaussian process the weights of the support points are drawn likewise; what the support leaves open
is a function of the prior, of random waves, less what the support says of it (Matheron's rule:
Wilson et al. 2020, ICML, Efficiently sampling functions from Gaussian process posteriors). So a
draw agrees with its own weights at the support and is free far from the data. Either way a draw is
a vector of numbers, and the variance over draws is the calibrated one of the posterior; of a
process between its support points to a quarter, as waves are few.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from greybox.model.dynamics import Dynamics
from greybox.model.layer import LearnedErrors, LearnedPush
from greybox.model.parameter import Parameter
from greybox.residual.errors_together import NoErrors
from greybox.residual.feature_posterior import FeaturePosterior
from greybox.residual.hybrid import HybridModel
from greybox.residual.kernels import Kernel
from greybox.residual.learners.learner import Features
from greybox.residual.posterior import GPPosterior
from greybox.symbolic import Expr, FloatArray, Namespace, Numeric

WAVES = 96
"""Random waves of a prior function; each is a cosine and a sine, so that the variance is exact
everywhere."""
FREEDOM = {"matern32": 3, "matern52": 5}
"""Degrees of freedom of the spectrum of a Matern kernel, a Student distribution; that of se is
normal."""


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class DrawnPush(LearnedPush):
    """A hybrid model whose learned weights are parameters, `learned.<output>.<number>`, after those
    of its base. At their nominal values it is the hybrid model."""

    hybrid: HybridModel

    @property
    def base(self) -> Dynamics:
        """The model that the push was learned for."""
        return self.hybrid.inner

    def on(self, base: Dynamics) -> DrawnPush:
        """The same push on another model."""
        return DrawnPush(hybrid=self.hybrid.on(base))

    @property
    def learned_rows(self) -> tuple[int, ...]:
        """As the hybrid model."""
        return self.hybrid.learned_rows

    @property
    def window(self) -> tuple[int, int]:
        """As the hybrid model."""
        return self.hybrid.window

    def learned_errors(self, states: FloatArray, windows: FloatArray) -> LearnedErrors:
        """None: a draw is one function."""
        return NoErrors(shape=(len(states), len(self.learned_rows)))

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Those of the base, then the weights."""
        own = []
        for o in self._outputs:
            name = self.hybrid.posterior.outputs.names[o.place]
            own += [
                Parameter(
                    name=f"learned.{name}.{i}",
                    unit="-",
                    nominal=float(v),
                    meaning=f"weight of the learned {name}",
                )
                for i, v in enumerate(o.mean)
            ]
        return (*self.base.parameters, *own)

    def draw(self, count: int, random: np.random.Generator) -> FloatArray:
        """Weights (count, P) of so many functions from the posterior."""
        return np.hstack(
            [np.zeros((count, 0)), *(o.mean + o.drawn(count, random) for o in self._outputs)]
        )

    def spread(self, weights: FloatArray) -> FloatArray:
        """Standard deviation (n_out,) between draws (count, P), mean over points of the training
        domain."""
        post = self.hybrid.posterior
        z = np.random.default_rng(0).uniform(
            post.domain.lower, post.domain.upper, (20, len(post.inputs))
        )
        at, w = ca.MX.sym("z", len(post.inputs)), ca.MX.sym("w", weights.shape[1])
        function = ca.Function("push", [at, w], [ca.densify(self._push(at, w))]).map(len(weights))
        both = [np.array(function(np.tile(row[:, None], len(weights)), weights.T)) for row in z]
        return np.asarray(np.std(both, axis=2).mean(axis=0))

    @cached_property
    def _outputs(self) -> tuple[_Output, ...]:
        post = self.hybrid.posterior
        of = _of_features if isinstance(post, FeaturePosterior) else _of_process
        return tuple(of(post, j) for j, on in enumerate(post.active) if on)  # type: ignore[arg-type]

    def _push(self, z: Expr, weights: Expr) -> Expr:
        """The push (n_out,) at features z."""
        post = self.hybrid.posterior
        x = (ca.reshape(z, len(post.inputs), 1) - post.input_mean) / post.input_scale
        out, start = [ca.DM(float(v)) for v in post.output_mean], 0
        for o in self._outputs:
            own = weights[start : start + len(o.mean)]
            out[o.place] = out[o.place] + post.output_scale[o.place] * ca.dot(own, o.features(x))
            start += len(o.mean)
        return ca.vertcat(*out)

    def _pushed(self, x: Expr, window: Expr, p: Expr, w: Expr) -> tuple[Expr, Expr]:
        n = len(self.base.parameters)
        push = self._push(self.hybrid.learned_inputs(x, window), p[n:])
        for i, row in enumerate(self.learned_rows):
            w = w + ca.vertcat(
                ca.DM.zeros(row, 1), push[i], ca.DM.zeros(len(self.noises) - row - 1, 1)
            )
        return p[:n], w

    def step(self, t: Expr, x: Expr, window: Expr, p: Expr, w: Expr, dt: Expr) -> Expr:
        """One sample with the drawn push held over it."""
        own, pushed = self._pushed(x, window, p, w)
        return super().step(t, x, window, own, pushed, dt)

    def output(
        self, t: Expr, x: Expr, window: Expr, p: Expr, w: Expr, dt: Expr, lasting: Expr = None
    ) -> Expr:
        """Outputs see the drawn push as they see the process noise of its channel."""
        own, pushed = self._pushed(x, window, p, w)
        return super().output(t, x, window, own, pushed, dt, lasting)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Output:
    """One learned output: `features` of a standardised x, `mean` (m,) of their weights, and `root`
    (k, m): k normal numbers times it are a draw about the mean."""

    place: int
    features: Features
    mean: FloatArray
    root: FloatArray

    def drawn(self, count: int, random: np.random.Generator) -> FloatArray:
        return np.asarray(random.standard_normal((count, len(self.root))) @ self.root)


def _of_features(post: FeaturePosterior, j: int) -> _Output:
    return _Output(place=j, features=post.phi, mean=post.weights[:, j], root=post.root[j])


def _of_process(post: GPPosterior, j: int) -> _Output:
    """Features: the kernel at the support (M), then the waves of a prior function and its linear
    part."""
    kernel, support = post.kernels[j], post.support.T
    wave = _waves(kernel, np.random.default_rng(j))

    def features(x: Expr) -> Expr:
        return ca.vertcat(kernel.covariance(support, x, ca), wave(x, ca))

    prior = wave(support, np)
    # of a prior function f = a'prior, what the support says: weights A (f(support) + noise), A =
    # L1'L1
    first = post.explained[j]
    taken = prior @ first.T @ first
    m, k = post.points, len(prior)
    root = np.zeros((2 * m + k, m + k))
    root[:m, :m] = post.uncertain[j]
    root[m : m + k, :m], root[m : m + k, m:] = -taken, np.eye(k)
    root[m + k :, :m] = _noise_root(first, kernel.covariance(support, support))
    mean = np.concatenate([post.weights[:, j], np.zeros(k)])
    return _Output(
        place=j, features=features, mean=mean, root=np.sqrt(post.variance_factor[j]) * root
    )


def _noise_root(first: FloatArray, covariance: FloatArray) -> FloatArray:
    """Root (m, m) of what noise at the support (covariance K) adds to the weights: A N A = A - A K
    A, for A = L1'L1 the inverse of K + N. Zero where A = K^-1: the weights of inducing points hold
    the noise already."""
    left, vectors = np.linalg.eigh(np.eye(len(first)) - first @ covariance @ first.T)
    return np.asarray(np.sqrt(np.maximum(left, 0.0))[:, None] * (vectors.T @ first))


def _waves(kernel: Kernel, random: np.random.Generator) -> Callable[[Numeric, Namespace], Numeric]:
    """Features (k, N) of x (n_in, N) whose products are the kernel's values on average, and exact
    for equal points."""
    direction = random.standard_normal((WAVES, len(kernel.lengthscales))) / kernel.lengthscales
    family = kernel.family.removeprefix("linear+")
    if family in FREEDOM:
        freedom = FREEDOM[family]
        direction *= np.sqrt(freedom / random.chisquare(freedom, (WAVES, 1)))
    size = np.sqrt(kernel.variance / WAVES)

    def wave(x: Numeric, xp: Namespace) -> Numeric:
        angle = direction @ x
        rows = [size * xp.cos(angle), size * xp.sin(angle)]
        if kernel.slopes is not None:
            rows.append(np.sqrt(kernel.slopes)[:, None] * kernel.features(x))
        return np.vstack(rows) if xp is np else ca.vertcat(*rows)

    return wave
