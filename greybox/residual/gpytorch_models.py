"""The posterior of a GPyTorch model as the plain numbers of `GaussianProcess`: one function per
kind of model.

Everything is computed here in float64 from hyper-parameters, data and variational parameters;
nothing of GPyTorch runs. Exact: Rasmussen and Williams (2006), algorithm 2.1, with the Kronecker
structure of several outputs (Bonilla, Chai and Williams, NIPS 2007) written out. Inducing points:
Titsias (AISTATS 2009) with GPyTorch's correction of the diagonal. Variational: Hensman, Fusi and
Lawrence (UAI 2013), whitened or not. LMC: Alvarez, Rosasco and Lawrence, Foundations and Trends in
Machine Learning 4(3) (2012)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.linalg import cho_solve, cholesky, qr, solve_triangular

from greybox.errors import DataError, ModelError
from greybox.residual.covariances import Covariance, Pick, read_module
from greybox.residual.covariances.covariance import numbers, same_forward
from greybox.residual.gaussian_process import Base, Latent
from greybox.symbolic import FloatArray

if TYPE_CHECKING:
    from gpytorch.distributions import MultivariateNormal as Normal
    from gpytorch.kernels import Kernel
    from gpytorch.likelihoods import Likelihood
    from gpytorch.means import Mean
    from gpytorch.models import GP
    from gpytorch.variational import _VariationalStrategy as Strategy
    from torch.nn import Module

JITTERS = (0.0, 1e-8, 1e-7, 1e-6)


@dataclass(frozen=True, kw_only=True, eq=False)
class Posterior:
    """Numbers of one model: its latent processes and how outputs mix them, noise (n_out,) and
    offset (n_out,) in the model's own units, training inputs or inducing points (N, n_in), and
    what it is."""

    bases: tuple[Base, ...]
    latents: tuple[Latent, ...]
    mixing: FloatArray
    noise: FloatArray
    offset: FloatArray
    inputs: FloatArray
    method: str


def kinds(module: object) -> set[str]:
    """Names of the classes that an object is an instance of."""
    return {c.__name__ for c in type(module).__mro__}


def read_model(model: GP, likelihood: Likelihood, jitter: float) -> Posterior:
    """The posterior of an ExactGP or ApproximateGP. `jitter` is what GPyTorch adds to K(Z, Z) of a
    variational model of this precision. Raises `ModelError` for what is not supported, by name,
    and `DataError` without data."""
    there = kinds(model)
    if "ApproximateGP" in there or "AbstractVariationalGP" in there:
        return _variational_model(model, likelihood, jitter)
    if "ExactGP" not in there:
        raise ModelError(
            f"{type(model).__name__} is not supported",
            expected="gpytorch.models.ExactGP or ApproximateGP",
            fix="hand over the model itself, with mean_module and covar_module",
        )
    if model.train_inputs is None or model.train_targets is None:
        raise DataError(
            f"{type(model).__name__} has no training data",
            expected="train_inputs and train_targets: an exact GP is its data",
            fix="model.set_train_data(train_x, train_y, strict=False) before from_gpytorch",
        )
    if len(model.train_inputs) != 1:
        raise ModelError(
            f"{len(model.train_inputs)} training inputs", expected="one tensor (N, n_in)"
        )
    covar = _module(model, "covar_module")
    if kinds(covar) & {"MultitaskKernel", "LCMKernel"}:
        return _multitask(model, likelihood, covar)
    return _exact(model, likelihood, covar)


def _module(model: GP, name: str) -> Module:
    if not hasattr(model, name):
        raise ModelError(
            f"{type(model).__name__} has no {name}",
            expected="mean_module and covar_module, as GPyTorch's examples have",
            fix=f"name the module self.{name}",
        )
    return getattr(model, name)


# -------------------- parts


def read_mean(module: Mean, pick: Pick, n_in: int, where: str) -> tuple[float, FloatArray]:
    """(c, s) of the prior mean c + s'x. Raises `ModelError` that names another mean."""
    own = type(module)
    for known in ("ZeroMean", "ConstantMean", "LinearMean"):
        base = next((c for c in own.__mro__ if c.__name__ == known), None)
        if base is None or not same_forward(own, base):
            continue
        if known == "ZeroMean":
            return 0.0, np.zeros(n_in)
        if known == "ConstantMean":
            return float(pick(module.constant, 0)), np.zeros(n_in)
        constant = 0.0 if module.bias is None else pick.scalar(module.bias, 1)
        return constant, pick(module.weights, 2)[:, 0]
    raise ModelError(
        f"{type(module).__name__} in {where} is not supported",
        expected="ZeroMean, ConstantMean or LinearMean",
    )


def noise_matrix(likelihood: Likelihood, n_out: int, samples: int) -> FloatArray:
    """Noise covariance (n_out, n_out) of one sample, or (samples, n_out) variances where they are
    fixed one by one.

    Raises `ModelError` for a likelihood that is not Gaussian and for a noise that is not positive.
    """
    names = kinds(likelihood)
    if "_MultitaskGaussianLikelihoodBase" in names or "MultitaskGaussianLikelihood" in names:
        total = np.zeros((n_out, n_out))
        if likelihood.has_task_noise and likelihood.rank == 0:
            total += np.diag(numbers(likelihood.task_noises).reshape(-1))
        elif likelihood.has_task_noise:
            factor = numbers(likelihood.task_noise_covar_factor)
            total += factor @ factor.T
        if likelihood.has_global_noise:
            total += numbers(likelihood.noise).reshape(()) * np.eye(n_out)
        _positive(np.asarray(np.linalg.eigvalsh(total)))
        return total
    if "FixedNoiseGaussianLikelihood" in names:
        fixed = numbers(likelihood.noise)
        second = getattr(likelihood, "second_noise", None)
        if second is not None and not isinstance(second, (int, float)):
            fixed = fixed + numbers(second)
        fixed = np.atleast_2d(fixed).T if fixed.ndim <= 2 else fixed.reshape(-1, samples).T
        _positive(fixed)
        return np.broadcast_to(fixed, (samples, n_out))
    if "GaussianLikelihood" in names:
        level = np.broadcast_to(numbers(likelihood.noise).reshape(-1), (n_out,))
        _positive(level)
        return np.diag(level)
    raise ModelError(
        f"{type(likelihood).__name__} is not supported",
        expected="GaussianLikelihood, FixedNoiseGaussianLikelihood or MultitaskGaussianLikelihood",
    )


def _factor(matrix: FloatArray) -> FloatArray:
    """Lower Cholesky factor, with the jitters that GPyTorch adds to a singular matrix (none, 1e-8,
    1e-7, 1e-6)."""
    for added in JITTERS:
        try:
            return np.asarray(cholesky(matrix + added * np.eye(len(matrix)), lower=True))
        except np.linalg.LinAlgError:
            continue
    raise ModelError(
        "a covariance matrix of the model is singular", fix="more noise, or fewer inducing points"
    )


def _positive(values: FloatArray) -> None:
    if not np.isfinite(values).all() or not (values > 0).all():
        raise ModelError(
            "the likelihood's noise is not positive",
            expected="a variance above 0",
            got=f"{np.min(values):.3g}",
            fix="look at likelihood.noise; train again with a constraint on it",
        )


def _batch(*modules: Module | None) -> int:
    """Size of the one batch dimension of the modules, 1 without."""
    sizes = {int(n) for m in modules for n in tuple(getattr(m, "batch_shape", ())) if int(n) != 1}
    if len(sizes) > 1:
        raise ModelError("modules with different batches", got=", ".join(map(str, sorted(sizes))))
    return sizes.pop() if sizes else 1


# -------------------- exact


def _data(model: GP, n_out: int) -> tuple[list[FloatArray], FloatArray]:
    """(inputs (N, n_in) per output, targets (N, n_out)) of an exact model: targets are (N,),
    (n_out, N) or (N, n_out)."""
    x, y = numbers(model.train_inputs[0]), numbers(model.train_targets)
    if x.ndim == 1:
        x = x[:, None]
    if not np.isfinite(x).all() or not np.isfinite(y).all():
        raise DataError("training data with NaN or infinity", fix="drop those rows and train again")
    samples = x.shape[-2]
    if y.ndim == 1:
        targets = y[:, None]
    elif x.ndim >= 3 or (y.shape[-1] == samples and y.shape[0] == n_out and n_out != samples):
        targets = y.reshape(-1, samples).T
    else:
        targets = y
    if targets.shape != (samples, n_out):
        raise DataError(
            "the training targets do not fit",
            expected=f"{samples} samples of {n_out} outputs",
            got=str(y.shape),
        )
    many = x.reshape(-1, samples, x.shape[-1])
    return [many[j if len(many) > 1 else 0] for j in range(n_out)], targets


def _exact(model: GP, likelihood: Likelihood, covar: Kernel) -> Posterior:
    """Independent outputs: one, or a batch; each by its own data, exactly or on inducing points."""
    mean = _module(model, "mean_module")
    shape = tuple(model.train_targets.shape)
    x0 = numbers(model.train_inputs[0])
    n_out = max(_batch(covar, getattr(covar, "base_kernel", None), mean), _targets(shape, x0))
    inputs, y = _data(model, n_out)
    level = noise_matrix(likelihood, n_out, len(y))
    if level.shape == (n_out, n_out) and np.any(level - np.diag(np.diag(level))):
        raise ModelError(
            "independent outputs with noise that is correlated between them are not supported"
        )
    sgpr = "InducingPointKernel" in kinds(covar)
    bases: list[Base] = []
    latents = []
    for j in range(n_out):
        pick = Pick(index=j)
        noise = (
            level[:, j]
            if level.shape != (n_out, n_out) or len(y) == n_out == 1
            else np.full(len(y), level[j, j])
        )
        constant, slope = read_mean(_member(mean, j), pick, inputs[j].shape[1], "mean_module")
        left = y[:, j] - constant - inputs[j] @ slope
        if sgpr:
            kernel = read_module(covar.base_kernel, pick, "covar_module.base_kernel")
            base = Base(covariance=kernel, support=pick(covar.inducing_points, 2))
            told = _inducing(kernel, base.support, inputs[j], left, noise)
        else:
            base = Base(covariance=read_module(covar, pick, "covar_module"), support=inputs[j])
            told = _full(base.covariance, inputs[j], left, noise)
        bases.append(base)
        latents.append(
            Latent(
                bases=(j,),
                prior=np.ones(1),
                constant=constant,
                slope=slope,
                weights=told.weights,
                explained=told.explained,
                uncertain=told.uncertain,
            )
        )
    spread = np.diag(level) if level.shape == (n_out, n_out) else level.mean(axis=0)
    return Posterior(
        bases=tuple(bases),
        latents=tuple(latents),
        mixing=np.eye(n_out),
        noise=np.array(spread),
        offset=np.zeros(n_out),
        inputs=inputs[0],
        method="sgpr" if sgpr else "exact",
    )


def _targets(shape: tuple[int, ...], x: FloatArray) -> int:
    """How many outputs targets of this shape have."""
    if len(shape) == 1:
        return 1
    if x.ndim >= 3:
        return int(np.prod(shape[:-1]))
    return shape[-1] if shape[0] == len(x) else int(np.prod(shape[:-1]))


def _member(mean: Mean, j: int) -> Mean:
    """The mean of output j: MultitaskMean holds one per output."""
    return mean.base_means[j] if "MultitaskMean" in kinds(mean) else mean


class _Told(NamedTuple):
    """Numbers of one latent process on one base."""

    weights: FloatArray
    explained: FloatArray
    uncertain: FloatArray


def _full(kernel: Covariance, x: FloatArray, y: FloatArray, noise: FloatArray) -> _Told:
    matrix = kernel.matrix(x, x)
    matrix[np.diag_indices(len(x))] += noise
    factor = _factor(matrix)
    inverse = solve_triangular(factor, np.eye(len(x)), lower=True)
    return _Told(cho_solve((factor, True), y), np.tril(inverse), np.zeros((0, len(x))))


def _inducing(
    kernel: Covariance, z: FloatArray, x: FloatArray, y: FloatArray, noise: FloatArray
) -> _Told:
    """Noise of every sample grows by the prior variance that the inducing points leave unexplained
    there."""
    factor = _factor(kernel.matrix(z, z))
    a = solve_triangular(factor, kernel.matrix(z, x), lower=True)
    left = np.maximum(kernel.variance(x.T, np).ravel() - (a * a).sum(axis=0), 0.0)
    a = a / np.sqrt(noise + left)
    inner = cholesky(np.eye(len(z)) + a @ a.T, lower=True)
    projected = cho_solve((inner, True), a @ (y / np.sqrt(noise + left)))
    inverse = np.tril(solve_triangular(factor, np.eye(len(z)), lower=True))
    return _Told(
        solve_triangular(factor, projected, lower=True, trans="T"),
        inverse,
        np.tril(solve_triangular(inner, inverse, lower=True)),
    )


# -------------------- several outputs


def _term(member: Kernel, x: FloatArray, where: str) -> tuple[Base, FloatArray]:
    """(k_q on the data, B_q) of one multitask kernel."""
    kernel = read_module(member.data_covar_module, Pick(), f"{where}.data_covar_module", whole=True)
    if getattr(member, "active_dims", None) is not None:
        raise ModelError(f"active dimensions of {type(member).__name__} in {where}: not supported")
    matrix = member.task_covar_module.covar_matrix
    dense = matrix.to_dense() if hasattr(matrix, "to_dense") else matrix
    return Base(covariance=kernel, support=x), numbers(dense)


def _multitask(model: GP, likelihood: Likelihood, covar: Kernel) -> Posterior:
    """K((x, i), (x', j)) = sum_q B_q[i, j] k_q(x, x') (ICM with one term, LMC with more), all
    samples of all outputs."""
    many = "LCMKernel" in kinds(covar)
    members = list(covar.covar_module_list) if many else [covar]
    n_out = int(members[0].num_tasks)
    inputs, y = _data(model, n_out)
    x, n = inputs[0], len(y)
    bases, between = [], []
    for i, member in enumerate(members):
        where = f"covar_module.covar_module_list.{i}" if many else "covar_module"
        base, matrix = _term(member, x, where)
        bases.append(base)
        between.append(matrix)
    own = noise_matrix(likelihood, n_out, n)
    if own.shape != (n_out, n_out):
        raise ModelError("FixedNoiseGaussianLikelihood with a multitask kernel is not supported")
    # Samples first, outputs inside: K_x (x) B.
    whole = sum(np.kron(base.covariance.matrix(x, x), b) for base, b in zip(bases, between))
    factor = _factor(np.asarray(whole + np.kron(np.eye(n), own)))
    mean = _module(model, "mean_module")
    affine = [
        read_mean(_member(mean, j), Pick(index=j), x.shape[1], "mean_module") for j in range(n_out)
    ]
    left = y - np.column_stack([c + x @ s for c, s in affine])
    alpha = cho_solve((factor, True), left.ravel()).reshape(n, n_out)
    latents = []
    for j, (constant, slope) in enumerate(affine):
        # The covariance of output j at x with all data is M_j k(x), the columns of every B_q
        # spread over the samples.
        spread = np.hstack([np.kron(np.eye(n), b[:, j : j + 1]) for b in between])
        seen = solve_triangular(factor, spread, lower=True)
        explained = np.asarray(qr(seen, mode="r")[0])[: seen.shape[1]]
        latents.append(
            Latent(
                bases=tuple(range(len(bases))),
                prior=np.array([b[j, j] for b in between]),
                weights=np.concatenate([alpha @ b[:, j] for b in between]),
                explained=explained,
                uncertain=np.zeros((0, seen.shape[1])),
                constant=constant,
                slope=slope,
            )
        )
    return Posterior(
        bases=tuple(bases),
        latents=tuple(latents),
        mixing=np.eye(n_out),
        noise=np.diag(own).copy(),
        offset=np.zeros(n_out),
        inputs=x,
        method="exact",
    )


# -------------------- variational


def _strategy(outer: Strategy) -> tuple[Strategy, FloatArray | None, int, float]:
    """(the inner strategy, LMC's mixing (n_out, n_f) or None, how often one process is repeated,
    the variance that LMC adds). Raises `ModelError` that names another strategy."""
    names, where = kinds(outer), "variational_strategy"
    mixing: FloatArray | None = None
    inner, repeats, offset = outer, 0, 0.0
    if names & {"LMCVariationalStrategy", "IndependentMultitaskVariationalStrategy"}:
        inner, where = outer.base_variational_strategy, f"{where}.base_variational_strategy"
        if "LMCVariationalStrategy" in names:
            mixing, offset = numbers(outer.lmc_coefficients).T, float(outer.jitter_val)
        else:
            repeats = int(outer.num_tasks)
    kind = type(inner).__name__
    if kind not in ("VariationalStrategy", "UnwhitenedVariationalStrategy"):
        raise ModelError(
            f"{kind} in {where} is not supported",
            expected="VariationalStrategy or UnwhitenedVariationalStrategy, "
            "alone or inside LMCVariationalStrategy or IndependentMultitaskVariationalStrategy",
        )
    return inner, mixing, repeats, offset


def _variational_model(model: GP, likelihood: Likelihood, jitter: float) -> Posterior:
    """q(u) on inducing points, whitened or not, alone, as a batch of independent outputs, or mixed
    (LMC)."""
    inner, mixing, repeats, offset = _strategy(model.variational_strategy)
    whitened = type(inner).__name__ == "VariationalStrategy"
    covar, mean = _module(model, "covar_module"), _module(model, "mean_module")
    q = inner.variational_distribution
    center, root = numbers(q.mean), _root(q, inner)
    n_f = _batch(covar, mean, inner._variational_distribution)
    added = float(getattr(inner, "jitter_val", jitter))
    bases, latents = [], []
    for j in range(n_f):
        pick = Pick(index=j)
        support = pick(inner.inducing_points, 2)
        base = Base(covariance=read_module(covar, pick, "covar_module"), support=support)
        constant, slope = read_mean(_member(mean, j), pick, support.shape[1], "mean_module")
        factor = _factor(base.covariance.matrix(support, support) + added * np.eye(len(support)))
        m, r = pick(center, 1), pick(root, 2)
        if not whitened:
            m = solve_triangular(factor, m - constant - support @ slope, lower=True)
            r = solve_triangular(factor, r, lower=True)
        inverse = np.tril(solve_triangular(factor, np.eye(len(support)), lower=True))
        bases.append(base)
        latents.append(
            Latent(
                bases=(j,),
                prior=np.ones(1),
                weights=solve_triangular(factor, m, lower=True, trans="T"),
                explained=inverse,
                uncertain=r.T @ inverse,
                constant=constant,
                slope=slope,
                offset=added if whitened else 0.0,
            )
        )
    if mixing is None:
        mixing = np.ones((repeats, 1)) if repeats and n_f == 1 else np.eye(n_f)
    n_out = len(mixing)
    noise = noise_matrix(likelihood, n_out, 1)
    return Posterior(
        bases=tuple(bases),
        latents=tuple(latents),
        mixing=mixing,
        noise=np.diag(noise).copy(),
        offset=np.full(n_out, offset),
        inputs=bases[0].support,
        method="svgp",
    )


def _root(q: Normal, strategy: Strategy) -> FloatArray:
    """A factor R of cov(q) = R R' (..., M, M)."""
    own = strategy._variational_distribution
    if "DeltaVariationalDistribution" in kinds(own):
        m = numbers(q.mean)
        return np.zeros((*m.shape, m.shape[-1]))
    if "CholeskyVariationalDistribution" in kinds(own):
        return np.tril(numbers(own.chol_variational_covar))
    covariance = numbers(q.covariance_matrix)
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :])
