"""Small Gaussian processes in plain numbers for the tests of the posterior."""

from __future__ import annotations

import numpy as np

from greybox.residual import sparse
from greybox.residual.kernels import Kernel, split_name
from greybox.residual.posterior import Domain, GPPosterior
from greybox.symbolic import Layout, Signal


def layout(prefix: str, n: int, unit: str = "m") -> Layout:
    return Layout([Signal(name=f"{prefix}{i}", unit=unit) for i in range(n)])


def make_kernel(name: str, n_in: int, rng: np.random.Generator) -> Kernel:
    family, linear = split_name(name)
    return Kernel(
        family=family,
        lengthscales=rng.uniform(0.8, 3.0, n_in),
        variance=float(rng.uniform(0.5, 2.0)),
        slopes=rng.uniform(0.05, 0.5, n_in) if linear else None,
        reach=np.full(n_in, 4.0) if linear else None,
    )


def posterior_of(
    numbers: list[sparse.Numbers],
    kernels: list[Kernel],
    support: np.ndarray,
    *,
    method: str = "sgpr",
    scales: np.random.Generator | None = None,
    noise: float = 0.01,
    **more: object,
) -> GPPosterior:
    """A posterior from standardised numbers; `scales` draws input and output scalings, else they
    are 1 and 0."""
    n_in, n_out = support.shape[1], len(kernels)
    draw = scales.uniform if scales is not None else None
    return GPPosterior(
        inputs=layout("z", n_in),
        outputs=layout("y", n_out),
        method=method,
        kernels=tuple(kernels),
        input_mean=draw(-1, 1, n_in) if draw else np.zeros(n_in),
        input_scale=draw(0.2, 5, n_in) if draw else np.ones(n_in),
        output_mean=draw(-1, 1, n_out) if draw else np.zeros(n_out),
        output_scale=draw(0.2, 5, n_out) if draw else np.ones(n_out),
        support=support,
        weights=np.stack([n.weights for n in numbers], axis=1),
        explained=np.stack([n.explained for n in numbers]),
        uncertain=np.stack([n.uncertain for n in numbers]),
        noise=np.full(n_out, noise),
        domain=Domain(lower=-np.ones(n_in), upper=np.ones(n_in)),
        **more,
    )


def sparse_case(
    name: str = "se",
    *,
    seed: int = 0,
    points: int = 20,
    n: int = 120,
    n_in: int = 3,
    n_out: int = 2,
    share: bool = False,
) -> GPPosterior:
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((n, n_in))
    kernels = [make_kernel(name, n_in, rng) for _ in range(n_out)]
    if share:
        kernels = [kernels[0]] * n_out
    y = np.stack(
        [np.sin(x[:, j % n_in]) + 0.1 * rng.standard_normal(n) for j in range(n_out)], axis=1
    )
    numbers = [sparse.collapsed(k, x[:points].T, x.T, y[:, j], 0.01) for j, k in enumerate(kernels)]
    return posterior_of(numbers, kernels, x[:points], scales=rng)
