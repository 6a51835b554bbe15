"""GPyTorch models of every kind that `from_gpytorch` reads, small and untrained: their numbers are
arbitrary."""

from __future__ import annotations

from contextlib import ExitStack, contextmanager

import gpytorch
import numpy as np
import torch
from gpytorch import kernels as k
from gpytorch import means, variational
from gpytorch.distributions import MultitaskMultivariateNormal, MultivariateNormal
from gpytorch.likelihoods import GaussianLikelihood, MultitaskGaussianLikelihood

N_IN, N, M = 3, 25, 8


def kernel(name: str, batch: int = 0):
    """A GPyTorch kernel of three inputs."""
    shape = torch.Size([batch] if batch else [])
    own = {"batch_shape": shape}
    return {
        "rbf": lambda: k.RBFKernel(**own),
        "rbf-ard": lambda: k.ScaleKernel(k.RBFKernel(ard_num_dims=3, **own), **own),
        "matern12": lambda: k.ScaleKernel(k.MaternKernel(nu=0.5, ard_num_dims=3, **own), **own),
        "matern32": lambda: k.MaternKernel(nu=1.5, ard_num_dims=3, **own),
        "matern52": lambda: k.ScaleKernel(k.MaternKernel(nu=2.5, **own), **own),
        "rq": lambda: k.RQKernel(ard_num_dims=3, **own),
        "periodic": lambda: k.ScaleKernel(k.PeriodicKernel(ard_num_dims=3, **own), **own),
        "linear": lambda: k.LinearKernel(ard_num_dims=3, **own),
        "polynomial": lambda: k.ScaleKernel(k.PolynomialKernel(power=2, **own), **own),
        "constant": lambda: k.RBFKernel(**own) + k.ConstantKernel(**own),
        "active": lambda: k.ScaleKernel(
            k.RBFKernel(active_dims=[0, 2], ard_num_dims=2, **own), **own
        ),
        "tree": lambda: k.ScaleKernel(
            k.RBFKernel(active_dims=[1], **own) * k.PeriodicKernel(active_dims=[0], **own)
            + k.LinearKernel(active_dims=[1, 2], ard_num_dims=2, **own)
            * k.MaternKernel(nu=2.5, **own),
            **own,
        ),
    }[name]()


KERNELS = (
    "rbf",
    "rbf-ard",
    "matern12",
    "matern32",
    "matern52",
    "rq",
    "periodic",
    "linear",
    "polynomial",
    "constant",
    "active",
    "tree",
)
MODELS = (
    "exact",
    "sgpr",
    "svgp",
    "svgp-unwhitened",
    "svgp-mean-field",
    "batch",
    "svgp-batch",
    "svgp-lmc",
    "icm",
    "lcm",
)


class Exact(gpytorch.models.ExactGP):
    def __init__(self, x, y, likelihood, mean, covar, outputs=1):
        super().__init__(x, y, likelihood)
        self.mean_module, self.covar_module, self.outputs = mean, covar, outputs

    def forward(self, x):
        prior = self.mean_module(x), self.covar_module(x)
        if self.outputs == "multitask":
            return MultitaskMultivariateNormal(*prior)
        own = MultivariateNormal(*prior)
        return own if self.outputs == 1 else MultitaskMultivariateNormal.from_batch_mvn(own)


class Variational(gpytorch.models.ApproximateGP):
    def __init__(self, z, kind, mean, covar, latents=0, outputs=0):
        shape = torch.Size([latents] if latents else [])
        family = (
            variational.MeanFieldVariationalDistribution
            if kind == "mean-field"
            else variational.CholeskyVariationalDistribution
        )
        strategy = (
            variational.UnwhitenedVariationalStrategy
            if kind == "unwhitened"
            else variational.VariationalStrategy
        )
        inner = strategy(self, z, family(M, batch_shape=shape), learn_inducing_locations=True)
        if kind == "batch":
            inner = variational.IndependentMultitaskVariationalStrategy(inner, num_tasks=latents)
        if kind == "lmc":
            inner = variational.LMCVariationalStrategy(
                inner, num_tasks=outputs, num_latents=latents
            )
        super().__init__(inner)
        self.mean_module, self.covar_module = mean, covar

    def forward(self, x):
        return MultivariateNormal(self.mean_module(x), self.covar_module(x))


def shaken(module, rng, size=0.3):
    """Every parameter moved by a random amount."""
    with torch.no_grad():
        for p in module.parameters():
            if p.requires_grad:
                p += size * torch.tensor(rng.standard_normal(p.shape), dtype=p.dtype)
    return module


def make(model: str, kernel_name: str, seed: int = 0, dtype=torch.float64):
    """(model, likelihood) in evaluation mode, of arbitrary numbers."""
    rng = np.random.default_rng(seed)
    x = torch.tensor(rng.standard_normal((N, N_IN)), dtype=dtype)
    y = torch.tensor(rng.standard_normal((N, 3)), dtype=dtype)
    z = torch.tensor(rng.standard_normal((M, N_IN)), dtype=dtype)
    likelihood = GaussianLikelihood()
    if model == "exact":
        own = Exact(x, y[:, 0], likelihood, means.LinearMean(N_IN), kernel(kernel_name))
    elif model == "sgpr":
        covar = k.InducingPointKernel(kernel(kernel_name), inducing_points=z, likelihood=likelihood)
        own = Exact(x, y[:, 0], likelihood, means.ConstantMean(), covar)
    elif model == "batch":
        likelihood = MultitaskGaussianLikelihood(num_tasks=3)
        mean = means.ConstantMean(batch_shape=torch.Size([3]))
        own = Exact(x, y, likelihood, mean, kernel(kernel_name, 3), outputs=3)
    elif model in ("icm", "lcm"):
        likelihood = MultitaskGaussianLikelihood(num_tasks=3, rank=1 if model == "icm" else 0)
        covar = k.MultitaskKernel(kernel(kernel_name), num_tasks=3, rank=2)
        if model == "lcm":
            covar = k.LCMKernel([kernel(kernel_name), k.RBFKernel()], num_tasks=3, rank=1)
        own = Exact(
            x,
            y,
            likelihood,
            means.MultitaskMean(means.ConstantMean(), num_tasks=3),
            covar,
            outputs="multitask",
        )
    else:
        kind = model.removeprefix("svgp").removeprefix("-")
        latents = {"batch": 3, "lmc": 2}.get(kind, 0)
        shape = torch.Size([latents] if latents else [])
        if latents:
            z = torch.stack([z + 0.1 * i for i in range(latents)])
            likelihood = MultitaskGaussianLikelihood(num_tasks=3)
        mean = means.ConstantMean(batch_shape=shape) if latents else means.LinearMean(N_IN)
        own = Variational(z, kind, mean, kernel(kernel_name, latents), latents, 3)
    own, likelihood = own.to(dtype), likelihood.to(dtype)
    if model.startswith("svgp"):  # the first call would draw the variational parameters anew
        own.variational_strategy.variational_params_initialized.fill_(1)
        base = getattr(own.variational_strategy, "base_variational_strategy", None)
        if base is not None:
            base.variational_params_initialized.fill_(1)
    return shaken(own, rng).eval(), shaken(likelihood, rng).eval()


@contextmanager
def exactly():
    """GPyTorch with Cholesky factors throughout."""
    s = gpytorch.settings
    with ExitStack() as stack:
        for setting in (
            s.fast_computations(False, False, False),
            s.max_cholesky_size(10**6),
            s.debug(False),
        ):
            stack.enter_context(setting)
        yield


def told(model, z: np.ndarray):
    """(mean (n_out,), variance (n_out,), Jacobians (n_out, n_in)) of the model at one point, by
    PyTorch's autograd."""
    point = torch.tensor(z[None], dtype=next(model.parameters()).dtype, requires_grad=True)
    with exactly():
        out = model(point)
        mean, variance = out.mean.reshape(-1), out.variance.reshape(-1)
    slopes = [
        np.array([torch.autograd.grad(v, point, retain_graph=True)[0].numpy()[0] for v in values])
        for values in (mean, variance)
    ]
    return mean.detach().numpy(), variance.detach().numpy(), *slopes
