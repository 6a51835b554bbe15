"""A learned part in weight space: what `fit_open_loop` asks of a candidate, whatever its features
are.

g_j(z) = s_j psi_j(x)'theta_j with theta ~ N(0, I) before the data. Of a Gaussian process psi_j =
L_j^-1 k_j(support, x) with K = L L'; of a learner's features psi = phi for every output. The two
kinds differ in this file and nowhere else.

The K members of an ensemble stand side by side as one wide column of features. Each is fitted on
its own, theta_k from its own block of the Hessian (`alone`); the ensemble is their mean, with
weights theta_k/K, and how much they disagree is part of its variance: a quadratic form of the same
features (Lakshminarayanan, Pritzel and Blundell 2017, NIPS).
"""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
from scipy.linalg import solve_triangular

from greybox.files import Json, Parsed
from greybox.residual.feature_posterior import FeaturePosterior
from greybox.residual.kernels import Kernel
from greybox.residual.posterior import GPPosterior
from greybox.residual.sparse import support_factor, variational
from greybox.symbolic import BoolArray, Expr, FloatArray, evaluate

Candidate = GPPosterior | FeaturePosterior
"""A learned part whose features are chosen and whose weights are open."""


def members_of(post: Candidate) -> int:
    """How many equal blocks of features are fitted each on its own; 1 of what is no ensemble."""
    return post.members if isinstance(post, FeaturePosterior) else 1


def alone(matrix: FloatArray, members: int, features: int) -> FloatArray:
    """A matrix (P, P) over the whitened weights of outputs with `features` each, without what
    couples one member with another; the matrix itself where there is one."""
    if members == 1:
        return matrix
    owner = np.arange(len(matrix)) % features // (features // members)
    return np.where(owner[:, None] == owner, matrix, 0.0)


def learned_numbers(post: Candidate) -> int:
    """How many numbers were learned: weights, and of a Gaussian process its support points and
    hyper-parameters."""
    if isinstance(post, FeaturePosterior):
        return int(post.weights.size)
    return int(post.support.size + post.weights.size) + len(post.outputs) * (len(post.inputs) + 2)


def called(post: Candidate) -> str:
    """What it is and what was learned, in a name: "GP(force.x, force.y)"."""
    label = post.method if isinstance(post, FeaturePosterior) else "GP"
    learned = [n for n, on in zip(post.outputs.names, post.active, strict=True) if on]
    return f"{label}({', '.join(learned) or 'nothing'})"


def written(post: Candidate) -> dict[str, Json]:
    """What a file holds of it, under the name of its kind."""
    return {"learned" if isinstance(post, FeaturePosterior) else "gp": post.to_dict()}


def read_part(data: Parsed) -> Candidate:
    """What `written` put into the values of a file. Raises `FileFormatError`, and `KeyError` where
    there is nothing of it."""
    return (
        GPPosterior.from_dict(data["gp"])
        if "gp" in data
        else FeaturePosterior.from_dict(data["learned"])
    )


def factors(post: Candidate) -> list[FloatArray]:
    """L_j per output; nothing of features, which are white already."""
    if isinstance(post, FeaturePosterior):
        return []
    support = post.support.T
    return [support_factor(k, support)[0] for k in post.kernels]


def whitened(post: Candidate, lower: list[FloatArray], x: FloatArray) -> list[FloatArray]:
    """psi_j (N, M) of every output at standardised inputs x (n_in, N); outputs that share share the
    array."""
    if isinstance(post, FeaturePosterior):
        return [evaluate(post.phi, np.ascontiguousarray(x.T))] * len(post.outputs)
    known: dict[int, FloatArray] = {}
    for j, kernel in enumerate(post.kernels):
        if id(kernel) not in known:
            covariance: FloatArray = kernel.covariance(post.support.T, x)
            psi = solve_triangular(lower[j], covariance, lower=True, check_finite=False)
            known[id(kernel)] = np.ascontiguousarray(psi.T)
    return [known[id(k)] for k in post.kernels]


def plain_weights(post: Candidate, lower: list[FloatArray], theta: FloatArray) -> FloatArray:
    """Weights (P,) as `weighted` takes them, of whitened theta (P,)."""
    if isinstance(post, FeaturePosterior):
        return theta
    parts = theta.reshape(len(post.outputs), post.points)
    return np.concatenate([np.linalg.solve(f.T, v) for f, v in zip(lower, parts, strict=True)])


def weighted(post: Candidate, z: Expr, weights: Expr) -> Expr:
    """The push (n_out,) at features z (n_in) for plain weights (P,), output by output."""
    x, m = (z - post.input_mean) / post.input_scale, post.points
    if isinstance(post, FeaturePosterior):
        phi = post.phi(x)
        return ca.vertcat(
            *(
                s * ca.dot(weights[j * m : (j + 1) * m], phi)
                for j, s in enumerate(post.output_scale)
            )
        )
    known: dict[int, Expr] = {}
    out = []
    for j, kernel in enumerate(post.kernels):
        if id(kernel) not in known:
            known[id(kernel)] = kernel.covariance(post.support.T, x, ca)
        out.append(post.output_scale[j] * ca.dot(weights[j * m : (j + 1) * m], known[id(kernel)]))
    return ca.vertcat(*out)


def silent(post: Candidate) -> Candidate:
    """The same with no weights: it says nothing."""
    if isinstance(post, FeaturePosterior):
        return replace(post, weights=np.zeros_like(post.weights), root=np.zeros_like(post.root))
    zero = {
        k: np.zeros_like(getattr(post, k))
        for k in ("weights", "explained", "uncertain", "output_mean")
    }
    return replace(post, **zero)


def without(post: Candidate, off: BoolArray, noise: FloatArray) -> Candidate:
    """The same whose outputs in `off` (n_out,) say nothing: no mean, no variance but their `noise`
    (n_out,)."""
    on, level = ~off, np.where(off, noise, post.noise)
    if isinstance(post, FeaturePosterior):
        return replace(
            post, weights=post.weights * on, root=post.root * on[:, None, None], noise=level
        )
    kernels = tuple(
        Kernel(family=k.family, lengthscales=k.lengthscales, variance=0.0) if o else k
        for k, o in zip(post.kernels, off, strict=True)
    )
    return replace(
        post,
        kernels=kernels,
        weights=post.weights * on,
        output_mean=post.output_mean * on,
        explained=post.explained * on[:, None, None],
        uncertain=post.uncertain * on[:, None, None],
        noise=level,
    )


def fitted(
    post: Candidate, theta: FloatArray, covariance: FloatArray, before: FloatArray
) -> Candidate:
    """Plain numbers of the fitted part from whitened theta (P,) and its covariance (P, P); an
    output that is off is empty. Of an ensemble: theta of the mean, covariance of the members.

    `before` (n_out,): variance of theta before the data, which is that far from them; zero of an
    output that is off.
    """
    m = post.points
    on = [j for j in range(len(post.outputs)) if before[j] > 0]
    roots = {}
    for j in on:
        rows = slice(j * m, (j + 1) * m)
        block = covariance[rows, rows]
        roots[j] = np.asarray(np.linalg.cholesky(0.5 * (block + block.T)), dtype=np.float64)
    if isinstance(post, FeaturePosterior):
        weights, root, prior = (
            np.zeros_like(post.weights),
            np.zeros_like(post.root),
            post.prior.copy(),
        )
        for j in on:
            weights[:, j] = theta[j * m : (j + 1) * m]
            root[j] = roots[j].T / np.sqrt(post.members)
            prior[j] = before[j] / post.members
            if post.members > 1:
                apart = _disagreement(weights[:, j], post.members)
                root[j] = np.linalg.cholesky(root[j].T @ root[j] + apart).T
        return replace(post, weights=weights, root=root, prior=prior)
    scale = post.output_scale.copy()
    arrays = {k: np.zeros_like(getattr(post, k)) for k in ("weights", "explained", "uncertain")}
    for j in on:
        rows, size = slice(j * m, (j + 1) * m), np.sqrt(before[j])
        numbers = variational(post.kernels[j], post.support.T, theta[rows] / size, roots[j] / size)
        arrays["weights"][:, j] = numbers.weights
        arrays["explained"][j], arrays["uncertain"][j] = numbers.explained, numbers.uncertain
        scale[j] *= size
    return replace(
        post,
        method="svgp",
        output_scale=scale,
        output_mean=np.zeros(len(post.outputs)),
        variance_factor=(),
        **arrays,
    )


def _disagreement(mean: FloatArray, members: int) -> FloatArray:
    """D (M, M) with phi'D phi the mean square distance of the members from their mean, from the
    weights (M,) of the mean."""
    own = np.zeros((members, mean.size))
    width = mean.size // members
    for k in range(members):
        at = slice(k * width, (k + 1) * width)
        own[k, at] = members * mean[at]
    away = own - mean
    return np.asarray(away.T @ away / members)
