"""The plain-number posterior is GPyTorch's: exact, SGPR and SVGP, for every kernel, under exact
Cholesky settings."""

from __future__ import annotations

from contextlib import ExitStack, contextmanager

import numpy as np
import pytest

from greybox.residual import sparse
from greybox.residual.marginal_likelihood import MarginalLikelihood

torch = pytest.importorskip("torch")
gpytorch = pytest.importorskip("gpytorch")
from greybox.residual import torch_gp  # noqa: E402 (after the skip)
from tests.residual.gp_cases import make_kernel, posterior_of  # noqa: E402

KERNELS = ("se", "matern32", "matern52", "linear+se", "linear+matern52")
EPS = np.finfo(float).eps


@contextmanager
def exact_settings(correction=True):
    s = gpytorch.settings
    chosen = (
        s.fast_computations(False, False, False),
        s.max_cholesky_size(100_000),
        s.max_eager_kernel_size(1),
        s.sgpr_diagonal_correction(correction),
        torch.no_grad(),
    )
    with ExitStack() as stack:
        for setting in chosen:
            stack.enter_context(setting)
        yield


def data(seed, n=60, n_in=3):
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((n, n_in))
    y = np.sin(x[:, 0]) + 0.5 * x[:, 1] + 0.1 * rng.standard_normal(n)
    queries = np.concatenate(
        [x[:5], rng.standard_normal((40, n_in)), 3.0 * rng.standard_normal((10, n_in))]
    )
    return rng, x, y, queries


def tolerance(condition):
    return 1e-9 if condition <= 1e7 else 10 * EPS * condition


def agrees(posterior, queries, mean, variance, condition):
    """Both in units of the output: mean to the tolerance times the output scale, variance times the
    prior variance."""
    z = queries * posterior.input_scale + posterior.input_mean
    got_mean, got_variance = posterior.evaluate(z)
    scale = float(posterior.output_scale[0])
    prior = posterior.kernels[0].prior_variance(queries.T).ravel()
    assert np.abs((got_mean[:, 0] - posterior.output_mean[0]) / scale - mean).max() <= tolerance(
        condition
    )
    assert (np.abs(got_variance[:, 0] / scale**2 - variance) / prior).max() <= tolerance(condition)
    assert (got_variance >= 0).all()


def exact_gpytorch(kernel, x, y, noise, queries):
    likelihood = torch_gp.gpytorch_likelihood(noise)
    model = torch_gp.ExactModel(
        torch.tensor(x), torch.tensor(y), likelihood, torch_gp.gpytorch_kernel(kernel)
    )
    model.eval(), likelihood.eval()
    with exact_settings():
        out = model(torch.tensor(queries))
        return out.mean.numpy(), out.variance.numpy()


@pytest.mark.parametrize("noise", [0.1, 1e-5, 1e-8])
@pytest.mark.parametrize("name", KERNELS)
def test_exact(name, noise):
    rng, x, y, queries = data(1)
    kernel = make_kernel(name, 3, rng)
    posterior = posterior_of(
        [sparse.exact(kernel, x.T, y, noise)], [kernel], x, method="exact", scales=rng
    )
    matrix = kernel.covariance(x.T, x.T) + noise * np.eye(len(x))
    agrees(
        posterior, queries, *exact_gpytorch(kernel, x, y, noise, queries), np.linalg.cond(matrix)
    )


@pytest.mark.parametrize("name", KERNELS)
def test_marginal_likelihood_and_its_gradient(name):
    rng, x, y, _ = data(7)
    kernel, noise = make_kernel(name, 3, rng), np.array([0.1, 0.02])
    columns = np.stack([y, np.cos(y)], axis=1)
    value, gradient = MarginalLikelihood(x, columns).value(kernel, noise)
    covariance = torch_gp.gpytorch_kernel(kernel)
    loss, levels = 0.0, []
    for column, level in zip(columns.T, noise, strict=True):
        likelihood = torch_gp.gpytorch_likelihood(level)
        model = torch_gp.ExactModel(
            torch.tensor(x), torch.tensor(column.copy()), likelihood, covariance
        )
        mll = gpytorch.mlls.ExactMarginalLogLikelihood(likelihood, model)
        with gpytorch.settings.fast_computations(False, False, False):
            loss = loss - len(x) * mll(model(torch.tensor(x)), model.train_targets)
        levels.append(likelihood.noise_covar.raw_noise)
    loss.backward()
    stationary = covariance if kernel.slopes is None else covariance.kernels[0]
    tensors = [stationary.base_kernel.raw_lengthscale, stationary.raw_outputscale]
    tensors += [] if kernel.slopes is None else [covariance.kernels[1].raw_variance]
    expected = np.concatenate([t.grad.numpy().ravel() for t in (*tensors, *levels)])
    assert value == pytest.approx(loss.item(), rel=1e-10)
    assert np.abs(gradient - expected).max() < 1e-9 * np.abs(expected).max()


@pytest.mark.parametrize("correction", [True, False])
@pytest.mark.parametrize("noise", [0.1, 1e-3])
@pytest.mark.parametrize("name", KERNELS)
def test_sgpr(name, noise, correction):
    rng, x, y, queries = data(2)
    kernel, support = make_kernel(name, 3, rng), x[:15] + 0.01
    likelihood = torch_gp.gpytorch_likelihood(noise)
    inducing = gpytorch.kernels.InducingPointKernel(
        torch_gp.gpytorch_kernel(kernel),
        inducing_points=torch.tensor(support),
        likelihood=likelihood,
    )
    model = torch_gp.ExactModel(torch.tensor(x), torch.tensor(y), likelihood, inducing)
    model.eval(), likelihood.eval()
    with exact_settings(correction):
        out = model(torch.tensor(queries))
        mean, variance = out.mean.numpy(), out.variance.numpy()
        if (
            not correction
        ):  # GPyTorch 1.15 then leaves the conditional prior variance out at the queries, too
            variance += (torch_gp.gpytorch_kernel(kernel)(torch.tensor(queries), diag=True)).numpy()
            variance -= inducing(torch.tensor(queries), diag=True).numpy()
    numbers = sparse.collapsed(kernel, support.T, x.T, y, noise, correction=correction)
    posterior = posterior_of([numbers], [kernel], support, scales=rng)
    kmm = kernel.covariance(support.T, support.T)
    kmn = kernel.covariance(support.T, x.T)
    condition = max(np.linalg.cond(kmm), np.linalg.cond(kmm + kmn @ kmn.T / noise))
    agrees(posterior, queries, mean, variance, condition)


@pytest.mark.parametrize("jitter", [1e-4, 1e-8])
@pytest.mark.parametrize("name", KERNELS)
def test_svgp(name, jitter):
    rng, x, _, queries = data(3)
    kernel, support = make_kernel(name, 3, rng), x[:15]
    m = len(support)
    mean, root = (
        rng.standard_normal(m),
        np.tril(0.2 * rng.standard_normal((m, m))) + 0.5 * np.eye(m),
    )
    model = torch_gp.VariationalModel(
        torch.tensor(support), torch_gp.gpytorch_kernel(kernel), jitter
    )
    q = model.variational_strategy._variational_distribution
    q.variational_mean.data, q.chol_variational_covar.data = torch.tensor(mean), torch.tensor(root)
    model.variational_strategy.variational_params_initialized.fill_(1)
    model.eval()
    with exact_settings():
        out = model(torch.tensor(queries))
        # GPyTorch also adds its jitter to the variance at the query, which is no part of the
        # process.
        expected = out.mean.numpy(), out.variance.numpy() - jitter
    numbers = sparse.variational(kernel, support.T, mean, root, jitter=jitter)
    posterior = posterior_of([numbers], [kernel], support, method="svgp", scales=rng)
    condition = np.linalg.cond(kernel.covariance(support.T, support.T) + jitter * np.eye(m))
    agrees(posterior, queries, *expected, condition)


def test_the_closed_form_is_the_optimum_of_the_variational_bound():
    """SGPR written as a whitened q(u) gives SGPR's predictions again."""
    rng, x, y, queries = data(4)
    kernel, support = make_kernel("se", 3, rng), x[:15]
    closed = sparse.collapsed(kernel, support.T, x.T, y, 0.05, correction=False, jitter=1e-8)
    factor, _ = sparse.safe_cholesky(kernel.covariance(support.T, support.T), 1e-8)
    half = closed.uncertain @ factor
    again = sparse.variational(
        kernel, support.T, factor.T @ closed.weights, np.linalg.cholesky(half.T @ half), jitter=1e-8
    )
    a, b = posterior_of([closed], [kernel], support), posterior_of([again], [kernel], support)
    for first, second in zip(a.evaluate(queries), b.evaluate(queries)):
        np.testing.assert_allclose(first, second, atol=1e-8)


def test_likelihoods_are_gpytorchs():
    rng, x, y, _ = data(5)
    kernel = make_kernel("se", 3, rng)
    model = torch_gp.ExactModel(
        torch.tensor(x),
        torch.tensor(y),
        torch_gp.gpytorch_likelihood(0.05),
        torch_gp.gpytorch_kernel(kernel),
    )
    model.train()
    mll = gpytorch.mlls.ExactMarginalLogLikelihood(model.likelihood, model)
    with exact_settings():
        expected = len(x) * mll(model(torch.tensor(x)), torch.tensor(y)).item()
    exact = sparse.exact(kernel, x.T, y, 0.05).log_likelihood
    assert exact == pytest.approx(expected, rel=1e-10)
    # All samples as support points: the bound is tight. Fewer: it is below.
    assert sparse.collapsed(
        kernel, x.T, x.T, y, 0.05, correction=False
    ).log_likelihood == pytest.approx(exact, rel=1e-6)
    assert sparse.collapsed(kernel, x[:10].T, x.T, y, 0.05, correction=False).log_likelihood < exact
