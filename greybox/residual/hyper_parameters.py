"""The search for the hyper-parameters of a Gaussian process, by exact marginal likelihood.

Arrays in and out are NumPy, samples are rows, inputs and outputs standardised, prior mean zero.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize

from greybox.errors import FitError
from greybox.residual.kernels import Kernel, split_name
from greybox.residual.marginal_likelihood import MarginalLikelihood
from greybox.symbolic import FloatArray

BOUNDS = {
    "lengthscale": (0.05, 100.0),
    "variance": (1e-6, 1e3),
    "slope": (1e-8, 1e2),
    "noise": (1e-6, 4.0),
}
"""In standardised units; the noise floor (a thousandth of the output's size) keeps condition
numbers in float64's reach."""
GRADIENT = 0.05
"""Largest projected gradient of the log likelihood [nats per unit of a log parameter] that counts
as converged."""
ITERATIONS = 200
COARSE = 200
"""Samples of the subset on which the starts compete before the best is polished on all of it."""


class TrainingAborted(Exception):
    """The likelihood is not a number any more."""


@dataclass(frozen=True, kw_only=True)
class Hyper:
    """Hyper-parameters of outputs that share `kernel`: noise variances (n,), and how the search for
    them ended."""

    kernel: Kernel
    noise: FloatArray
    log_likelihood: float
    status: str
    message: str
    evaluations: int
    at_bound: tuple[str, ...] = ()


def pack(kernel: Kernel, noise: FloatArray) -> FloatArray:
    """Logarithms of length-scales, variance, slopes (where there are any) and noises (n,)."""
    parts = [kernel.lengthscales, np.array([kernel.variance])]
    if kernel.slopes is not None:
        parts.append(kernel.slopes)
    return np.log(np.concatenate([*parts, noise]))


def unpack(theta: FloatArray, like: Kernel) -> tuple[Kernel, FloatArray]:
    """Kernel and noises (n,) of what `pack` gives; `like` is a kernel of the same kind."""
    n = len(like.lengthscales)
    values = np.exp(theta)
    slopes = values[n + 1 : 2 * n + 1] if like.slopes is not None else None
    kernel = replace(like, lengthscales=values[:n], variance=float(values[n]), slopes=slopes)
    return kernel, values[n + 1 + (n if slopes is not None else 0) :]


def _bounds(like: Kernel, outputs: int) -> FloatArray:
    n = len(like.lengthscales)
    rows = [BOUNDS["lengthscale"]] * n + [BOUNDS["variance"]]
    rows += [BOUNDS["slope"]] * (n if like.slopes is not None else 0) + [BOUNDS["noise"]] * outputs
    return np.log(np.array(rows))


def _likelihood_of(
    x: FloatArray, y: FloatArray, like: Kernel
) -> Callable[[FloatArray], tuple[float, FloatArray]]:
    """theta -> (minus log marginal likelihood of y (N, n) at x (N, n_in) summed over columns,
    gradient)."""
    exact = MarginalLikelihood(x, y)

    def value(theta: FloatArray) -> tuple[float, FloatArray]:
        kernel, noise = unpack(theta, like)
        try:
            loss, gradient = exact.value(kernel, noise)
        except FitError as error:
            raise TrainingAborted(str(error).splitlines()[0]) from None
        if not math.isfinite(loss) or not np.isfinite(gradient).all():
            raise TrainingAborted("the likelihood is not finite")
        return loss, gradient

    return value


def _search(
    x: FloatArray, y: FloatArray, like: Kernel, start: FloatArray, iterations: int
) -> Hyper:
    """L-BFGS-B from one start. "converged" only if the projected gradient really is small."""
    bounds = _bounds(like, y.shape[1])
    function = _likelihood_of(x, y, like)
    first = np.clip(start, bounds[:, 0], bounds[:, 1])
    best = math.inf, first, np.full(start.shape, np.inf)
    count = 0

    def value(theta: FloatArray) -> tuple[float, FloatArray]:
        nonlocal best, count
        count += 1
        f, g = function(theta)
        if f < best[0]:
            best = f, theta.copy(), g.copy()
        return f, g

    status, message = "iteration limit", ""
    try:
        done = minimize(
            value,
            first,
            jac=True,
            method="L-BFGS-B",
            bounds=bounds,
            options={
                "maxiter": iterations,
                "maxfun": 2 * iterations,
                "gtol": 0.5 * GRADIENT,
                "ftol": 1e-12,
                "maxcor": 20,
            },
        )
        message = str(done.message)
    except TrainingAborted as error:
        status, message = "diverged", str(error)
    f, theta, gradient = best
    projected = np.clip(theta - gradient, bounds[:, 0], bounds[:, 1]) - theta
    if status != "diverged" and np.abs(projected).max() <= GRADIENT:
        status = "converged"
    kernel, noise = unpack(theta, like)
    return Hyper(
        kernel=kernel,
        noise=noise,
        log_likelihood=-f,
        status=status,
        message=message,
        evaluations=count,
        at_bound=_at_bound(theta, bounds, like),
    )


def _at_bound(theta: FloatArray, bounds: FloatArray, like: Kernel) -> tuple[str, ...]:
    """Names of parameters at their bounds; a length-scale at its upper bound only says that the
    input does not matter."""
    n = len(like.lengthscales)
    slopes = n if like.slopes is not None else 0
    names = (
        [f"lengthscale {i}" for i in range(n)]
        + ["variance"]
        + [f"slope {i}" for i in range(slopes)]
    )
    names += ["noise"] * (len(theta) - len(names))
    low, high = theta <= bounds[:, 0] + 1e-6, theta >= bounds[:, 1] - 1e-6
    high[:n] = False
    low[n + 1 : n + 1 + slopes] = False
    return tuple(name for name, hit in zip(names, low | high) if hit)


def fit_hyper(
    x: FloatArray,
    y: FloatArray,
    *,
    kernel: str,
    reach: FloatArray,
    seed: int,
    restarts: int,
    start: Hyper | None = None,
) -> Hyper:
    """Hyper-parameters of one kernel for the columns of y (N, n), by marginal likelihood. x (N,
    n_in), standardised.

    `restarts` starts compete on `COARSE` samples; the best goes on with all. With `start` only that
    one is polished. Raises `FitError` where the likelihood is not finite at any start.
    """
    family, linear = split_name(kernel)
    n_in, n_out = x.shape[1], y.shape[1]
    rng = np.random.default_rng(seed)
    slopes = np.full(n_in, 0.1) if linear else None
    like = Kernel(
        family=family,
        lengthscales=np.ones(n_in),
        variance=1.0,
        slopes=slopes,
        reach=reach if linear else None,
    )
    if start is not None:
        starts = [pack(replace(start.kernel, reach=like.reach), start.noise)]
    else:
        first = [(2.0 * math.sqrt(n_in), 0.5, 0.2), (math.sqrt(n_in), 0.5, 0.5)]
        starts = []
        for i in range(max(restarts, 1)):
            if i < len(first):
                scale, variance, noise = np.full(n_in, first[i][0]), first[i][1], first[i][2]
            else:
                scale, variance = (
                    np.exp(rng.uniform(0.0, np.log(10.0), n_in)),
                    float(np.exp(rng.uniform(-2.0, 1.0))),
                )
                noise = float(np.exp(rng.uniform(np.log(0.01), 0.0)))
            starts.append(
                pack(replace(like, lengthscales=scale, variance=variance), np.full(n_out, noise))
            )
    rows = np.sort(rng.permutation(len(x))[:COARSE])
    used = 0
    if len(starts) > 1 or len(x) > 2 * COARSE:
        tried = [_search(x[rows], y[rows], like, s, 60) for s in starts]
        used = sum(t.evaluations for t in tried)
        tried = [t for t in tried if math.isfinite(t.log_likelihood)]
        if tried:
            best = max(tried, key=lambda t: t.log_likelihood)
            starts = [pack(best.kernel, best.noise)]
    final = _search(x, y, like, starts[0], ITERATIONS)
    if not math.isfinite(final.log_likelihood):
        raise FitError(
            "the GP's likelihood is not finite",
            got=final.message,
            fix="look for infinite or huge inputs",
        )
    return replace(final, evaluations=final.evaluations + used)
