"""The part of training that runs in GPyTorch: polish of support points, SVGP with mini-batches.

The only file of the GP that imports PyTorch and GPyTorch (the extra `gp`). Arrays in and out are
NumPy, samples are rows, inputs and outputs standardised, prior mean zero. Everything is float64
with exact Cholesky settings. All of it is one file, though long, because PyTorch shall have one
door.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import gpytorch
import numpy as np
import torch
from linear_operator import LinearOperator
from linear_operator.utils.errors import NanError, NotPSDError
from scipy.optimize import minimize

from greybox.residual import sparse
from greybox.residual.hyper_parameters import BOUNDS, TrainingAborted, pack, unpack
from greybox.residual.kernels import FADE_POWER, Kernel, correlation
from greybox.symbolic import FloatArray

SVGP_JITTER = 1e-8


@contextmanager
def one_thread() -> Iterator[None]:
    """PyTorch on one thread: matrices of a few hundred rows are slower on more."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


class _FadedLinear(gpytorch.kernels.LinearKernel):
    """GPyTorch's linear kernel of the features of `Kernel.features`."""

    def __init__(self, reach: FloatArray, **kwargs: object) -> None:
        super().__init__(ard_num_dims=len(reach), **kwargs)
        self.register_buffer("reach", torch.tensor(reach, dtype=torch.float64))

    def _features(self, x: torch.Tensor) -> torch.Tensor:
        return x / (1.0 + ((x / self.reach) ** FADE_POWER).sum(-1, keepdim=True))

    def forward(self, x1: torch.Tensor, x2: torch.Tensor, **kwargs: object) -> LinearOperator:
        """The covariance of GPyTorch's kernel protocol."""
        return super().forward(self._features(x1), self._features(x2), **kwargs)


def _positive() -> gpytorch.constraints.Positive:
    return gpytorch.constraints.Positive(transform=torch.exp, inv_transform=torch.log)


def gpytorch_kernel(kernel: Kernel) -> gpytorch.kernels.Kernel:
    """The same kernel as a GPyTorch module (float64), its raw parameters being logarithms."""
    n = len(kernel.lengthscales)
    if kernel.family == "se":
        base = gpytorch.kernels.RBFKernel(ard_num_dims=n, lengthscale_constraint=_positive())
    else:
        nu = {"matern32": 1.5, "matern52": 2.5}[kernel.family]
        base = gpytorch.kernels.MaternKernel(
            nu=nu, ard_num_dims=n, lengthscale_constraint=_positive()
        )
    module = gpytorch.kernels.ScaleKernel(base, outputscale_constraint=_positive()).double()
    base.lengthscale = torch.tensor(np.array(kernel.lengthscales))
    module.outputscale = torch.tensor(kernel.variance, dtype=torch.float64)
    if kernel.slopes is None or kernel.reach is None:
        return module
    linear = _FadedLinear(np.array(kernel.reach), variance_constraint=_positive()).double()
    linear.variance = torch.tensor(np.array(kernel.slopes))
    return module + linear


def gpytorch_likelihood(noise: float) -> gpytorch.likelihoods.GaussianLikelihood:
    """A Gaussian likelihood with that noise variance (float64), its raw parameter being the
    logarithm."""
    likelihood = gpytorch.likelihoods.GaussianLikelihood(noise_constraint=_positive()).double()
    likelihood.noise = torch.tensor(noise, dtype=torch.float64)
    return likelihood


class ExactModel(gpytorch.models.ExactGP):
    """GPyTorch's exact GP with zero mean and the given covariance module."""

    def __init__(
        self,
        x: torch.Tensor,
        y: torch.Tensor,
        likelihood: gpytorch.likelihoods.GaussianLikelihood,
        covariance: gpytorch.kernels.Kernel,
    ) -> None:
        super().__init__(x, y, likelihood)
        self.mean_module = gpytorch.means.ZeroMean()
        self.covar_module = covariance

    def forward(self, x: torch.Tensor) -> gpytorch.distributions.MultivariateNormal:
        """Prior at x."""
        return gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))


class VariationalModel(gpytorch.models.ApproximateGP):
    """GPyTorch's SVGP (whitened) with zero mean, fixed inducing points and the given covariance
    module."""

    def __init__(
        self, support: torch.Tensor, covariance: gpytorch.kernels.Kernel, jitter: float = 1e-8
    ) -> None:
        q = gpytorch.variational.CholeskyVariationalDistribution(support.shape[0]).double()
        super().__init__(
            gpytorch.variational.VariationalStrategy(
                self, support, q, learn_inducing_locations=False, jitter_val=jitter
            )
        )
        self.mean_module = gpytorch.means.ZeroMean()
        self.covar_module = covariance

    def forward(self, x: torch.Tensor) -> gpytorch.distributions.MultivariateNormal:
        """Prior at x."""
        return gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))


# ------------------------------------------------------------------------------ sparse objectives


def _features(x: torch.Tensor, reach: torch.Tensor) -> torch.Tensor:
    return x / (1.0 + ((x / reach) ** FADE_POWER).sum(-1, keepdim=True))


def _covariance(
    family: str, raw: dict[str, torch.Tensor], a: torch.Tensor, b: torch.Tensor
) -> torch.Tensor:
    u, v = a / raw["lengthscale"].exp(), b / raw["lengthscale"].exp()
    square = (u * u).sum(-1)[:, None] + (v * v).sum(-1)[None, :] - 2.0 * u @ v.T
    k = raw["variance"].exp() * correlation(family, square, torch)[0]
    if "slope" in raw:
        k = k + (_features(a, raw["reach"]) * raw["slope"].exp()) @ _features(b, raw["reach"]).T
    return k


def polish(
    x: FloatArray,
    y: FloatArray,
    kernels: Sequence[Kernel],
    noise: FloatArray,
    support: FloatArray,
    *,
    iterations: int,
) -> tuple[list[Kernel], FloatArray, FloatArray, str]:
    """Move support points, kernels and noise up the gradient of the Titsias bound, summed over
    outputs (L-BFGS).

    x (N, n_in), y (N, n_out), support (M, n_in). Returns (kernels, noise, support, status); outputs
    that shared a kernel still do. The start comes back, with status "diverged", where the bound is
    not finite.
    """
    unique = list({id(k): k for k in kernels}.values())
    packing = _Packing(
        kernels=unique,
        places=[next(i for i, u in enumerate(unique) if u is k) for k in kernels],
        points=len(support),
        n_in=x.shape[1],
    )
    box = packing.bounds(np.abs(x).max(0))
    thetas = [pack(k, np.empty(0)) for k in unique]
    start = np.concatenate([support.ravel(), *thetas, np.log(noise)])
    inputs, targets = torch.tensor(x), torch.tensor(y)

    def value(theta: FloatArray) -> tuple[float, FloatArray]:
        t = torch.tensor(theta, requires_grad=True)
        loss = _titsias(packing, t, inputs, targets)
        loss.backward()
        assert t.grad is not None
        gradient = t.grad.numpy()
        if not math.isfinite(loss.item()) or not np.isfinite(gradient).all():
            raise TrainingAborted("the bound is not finite")
        return loss.item(), gradient

    try:
        done = minimize(
            value,
            np.clip(start, box[:, 0], box[:, 1]),
            jac=True,
            method="L-BFGS-B",
            bounds=box,
            options={"maxiter": iterations, "maxfun": 2 * iterations, "maxcor": 20, "ftol": 1e-10},
        )
    except (TrainingAborted, torch.linalg.LinAlgError):
        return list(kernels), noise, support, "diverged"
    moved, level, placed = packing.unpacked(done.x)
    return moved, level, placed, "converged" if done.success else "iteration limit"


@dataclass(frozen=True, kw_only=True)
class _Packing:
    """How support points (points, n_in), the logarithms of `kernels`' numbers and of noise levels
    follow each other in one vector; `places` are the kernel of every output."""

    kernels: Sequence[Kernel]
    places: Sequence[int]
    points: int
    n_in: int

    def bounds(self, span: FloatArray) -> FloatArray:
        """(n, 2); support points stay within 1.2 times the `span` (n_in,) of the inputs."""
        low, high = (
            np.log([BOUNDS[b][i] for b in ("lengthscale", "variance", "slope", "noise")])
            for i in (0, 1)
        )
        bounds = [(-s, s) for _ in range(self.points) for s in 1.2 * span + 1e-9]
        for k in self.kernels:
            bounds += [(low[0], high[0])] * self.n_in + [(low[1], high[1])]
            bounds += [(low[2], high[2])] * (self.n_in if k.slopes is not None else 0)
        bounds += [(low[3], high[3])] * len(self.places)
        return np.array(bounds)

    def parts(
        self, t: torch.Tensor
    ) -> tuple[torch.Tensor, list[dict[str, torch.Tensor]], torch.Tensor]:
        """Support points, the raw numbers of every kernel, logarithms of noise variances."""
        at = self.points * self.n_in
        z, raws = t[:at].reshape(self.points, self.n_in), []
        for k in self.kernels:
            raw = {"lengthscale": t[at : at + self.n_in], "variance": t[at + self.n_in]}
            at += self.n_in + 1
            if k.slopes is not None:
                raw["slope"], raw["reach"] = (
                    t[at : at + self.n_in],
                    torch.tensor(np.array(k.reach)),
                )
                at += self.n_in
            raws.append(raw)
        return z, raws, t[at:]

    def unpacked(self, theta: FloatArray) -> tuple[list[Kernel], FloatArray, FloatArray]:
        """The kernel of every output, noise variances, support points."""
        at = self.points * self.n_in
        placed, moved = theta[:at].reshape(self.points, self.n_in), []
        for k in self.kernels:
            length = self.n_in + 1 + (self.n_in if k.slopes is not None else 0)
            moved.append(unpack(theta[at : at + length], k)[0])
            at += length
        return [moved[i] for i in self.places], np.exp(theta[at:]), placed


def _titsias(
    packing: _Packing, t: torch.Tensor, inputs: torch.Tensor, targets: torch.Tensor
) -> torch.Tensor:
    """The negative bound on the log marginal likelihood, summed over outputs (Titsias 2009,
    AISTATS), at inputs (N, n_in) and targets (N, n_out)."""
    n, m = len(inputs), packing.points
    z, raws, levels = packing.parts(t)
    loss = torch.zeros((), dtype=torch.float64)
    for j, place in enumerate(packing.places):
        raw, level = raws[place], levels[j].exp()
        family = packing.kernels[place].family
        prior = raw["variance"].exp()
        diagonal = n * prior
        if "slope" in raw:
            diagonal = diagonal + (_features(inputs, raw["reach"]) ** 2 @ raw["slope"].exp()).sum()
        kmm = _covariance(family, raw, z, z) + 1e-8 * prior * torch.eye(m, dtype=torch.float64)
        factor = torch.linalg.cholesky(kmm)
        a = (
            torch.linalg.solve_triangular(factor, _covariance(family, raw, z, inputs), upper=False)
            / level.sqrt()
        )
        inner = torch.linalg.cholesky(torch.eye(m, dtype=torch.float64) + a @ a.T)
        target = targets[:, j] / level.sqrt()
        c = torch.linalg.solve_triangular(inner, (a @ target)[:, None], upper=False)
        loss = loss + 0.5 * (
            n * torch.log(2.0 * math.pi * level)
            + 2.0 * inner.diagonal().log().sum()
            + target @ target
            - (c * c).sum()
            + diagonal / level
            - (a * a).sum()
        )
    return loss


def train_svgp(
    x: FloatArray,
    y: FloatArray,
    kernel: Kernel,
    noise: float,
    support: FloatArray,
    *,
    tau: float,
    seed: int,
    epochs: int,
    batch: int = 1024,
    rate: float = 0.01,
) -> tuple[Kernel, float, sparse.Numbers, str]:
    """SVGP of one output with mini-batches: kernel, noise and q(u) by Adam on GPyTorch's evidence
    bound.

    Starts at the closed-form q(u) of the given hyper-parameters, so that a few epochs refine rather
    than search. x (N, n_in), y (N,), support (M, n_in). `tau` divides the weight of the data (noise
    inflation). Returns (kernel, noise variance, numbers, status); where the bound falls below its
    start by more than it may scatter, or is not finite, the start comes back with status
    "diverged".
    """
    torch.manual_seed(seed)
    closed = sparse.collapsed(
        kernel, support.T, x.T, y, noise * tau, correction=False, jitter=SVGP_JITTER
    )
    covariance, likelihood = gpytorch_kernel(kernel), gpytorch_likelihood(noise)
    model = _at_closed_form(kernel, support, closed, covariance)
    q = model.variational_strategy._variational_distribution
    model.train()
    bound = gpytorch.mlls.VariationalELBO(likelihood, model, num_data=len(y) / tau)
    parameters = [*model.parameters(), *likelihood.parameters()]
    optimiser = torch.optim.Adam(parameters, lr=rate)
    inputs, targets = torch.tensor(x), torch.tensor(y)
    draw = np.random.default_rng(seed)
    history: list[float] = []
    for epoch in range(epochs):
        for group in optimiser.param_groups:
            group["lr"] = rate * 0.5 * (1.0 + math.cos(math.pi * epoch / epochs))
        total, steps = 0.0, 0
        order = draw.permutation(len(y))
        for at in range(0, len(y), batch):
            rows = torch.tensor(order[at : at + batch])
            optimiser.zero_grad()
            try:
                with gpytorch.settings.fast_computations(False, False, False):
                    loss = -bound(model(inputs[rows]), targets[rows])
                loss.backward()
            except (NanError, NotPSDError, RuntimeError):
                return kernel, noise, closed, "diverged"
            optimiser.step()
            total, steps = total + loss.item(), steps + 1
        history.append(total / steps)
        if not math.isfinite(history[-1]) or history[-1] > history[0] + 1.0:
            return kernel, noise, closed, "diverged"
    trained = kernel_of(covariance, kernel)
    root = torch.tril(q.chol_variational_covar).detach().numpy()
    numbers = sparse.variational(
        trained, support.T, q.variational_mean.detach().numpy(), root, jitter=SVGP_JITTER
    )
    return trained, float(likelihood.noise.item()), numbers, _status(history)


def _status(history: Sequence[float]) -> str:
    """With the step size gone to zero, an unchanged bound means an optimum rather than a pause."""
    still = len(history) > 2 and abs(history[-1] - history[-2]) < 1e-3
    return "converged" if still and history[-1] <= history[0] + 1e-3 else "iteration limit"


def _at_closed_form(
    kernel: Kernel,
    support: FloatArray,
    closed: sparse.Numbers,
    covariance: gpytorch.kernels.Kernel,
) -> VariationalModel:
    """The model with the q(u) of the closed form."""
    factor, _ = sparse.safe_cholesky(kernel.covariance(support.T, support.T), SVGP_JITTER)
    inverse_root = closed.uncertain @ factor
    model = VariationalModel(torch.tensor(support), covariance, SVGP_JITTER)
    q = model.variational_strategy._variational_distribution
    q.variational_mean.data = torch.tensor(factor.T @ closed.weights)
    q.chol_variational_covar.data = torch.tensor(
        sparse.safe_cholesky(inverse_root.T @ inverse_root)[0]
    )
    model.variational_strategy.variational_params_initialized.fill_(1)
    return model


def kernel_of(module: gpytorch.kernels.Kernel, like: Kernel) -> Kernel:
    """Read a module of `gpytorch_kernel(like)` back into plain numbers."""
    stationary = module if like.slopes is None else module.kernels[0]
    slopes = None if like.slopes is None else module.kernels[1].variance.detach().numpy().ravel()
    return replace(
        like,
        lengthscales=stationary.base_kernel.lengthscale.detach().numpy().ravel(),
        variance=float(stationary.outputscale.item()),
        slopes=slopes,
    )
