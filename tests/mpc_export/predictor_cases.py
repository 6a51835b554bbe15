"""Everything fitted that is no identified model, small: hybrids, NARX, LSTM, GPs alone, with
hand-made Gaussian processes."""

from __future__ import annotations

import functools

import numpy as np

from greybox.baselines.base_predictor import BasePredictor
from greybox.baselines.decoupled import combined
from greybox.baselines.linear_predictor import LinearPredictor
from greybox.baselines.lstm import LSTMModel
from greybox.baselines.narx import NARXModel
from greybox.baselines.output_residual import OutputHybrid
from greybox.baselines.predictor_features import layout_of
from greybox.baselines.regressors import Lags
from greybox.data import Segment, dataset_from_arrays
from greybox.model.linear import LinearModel
from greybox.model.matrices import Matrices
from greybox.residual import sparse
from greybox.residual.covariances import OnDims, RationalQuadratic, Scaled, Sum
from greybox.residual.covariances.linear import Linear
from greybox.residual.gaussian_process import Base, GaussianProcess, Latent
from greybox.residual.kernels import Kernel
from greybox.residual.posterior import Domain, GPPosterior
from greybox.symbolic import Layout, Signal

DT = 0.02


def posterior(inputs: Layout, outputs: Layout, seed: int = 0, points: int = 6) -> GPPosterior:
    """A sparse GP of random data around typical inputs of one unit's size."""
    rng = np.random.default_rng(seed)
    n, m = len(inputs), len(outputs)
    kernels = [
        Kernel(family="se", lengthscales=rng.uniform(1, 3, n), variance=1.0) for _ in range(m)
    ]
    x, y, support = (
        rng.standard_normal((n, 30)),
        rng.standard_normal((30, m)),
        rng.standard_normal((n, points)),
    )
    numbers = [sparse.collapsed(k, support, x, y[:, j], 0.3) for j, k in enumerate(kernels)]
    return GPPosterior(
        inputs=inputs,
        outputs=outputs,
        method="sgpr",
        kernels=tuple(kernels),
        input_mean=np.full(n, 0.1),
        input_scale=np.full(n, 0.5),
        output_mean=np.zeros(m),
        output_scale=np.full(m, 0.05),
        support=support.T,
        weights=np.stack([v.weights for v in numbers], 1),
        explained=np.stack([v.explained for v in numbers]),
        uncertain=np.stack([v.uncertain for v in numbers]),
        noise=np.full(m, 0.01**2),
        domain=Domain(
            lower=np.full(n, -1.0), upper=np.full(n, 1.0), distance=(0.1, 0.3, 0.5, 0.9), samples=30
        ),
    )


def siso(output: str = "p", channel: str = "roll", delay: int = 2) -> LinearModel:
    """A first-order system in innovation form."""
    m = Matrices(*(np.array([[v]]) for v in (0.9, 0.5, 1.0, 0.0, 0.3)))
    return LinearModel(
        name=f"{channel}",
        matrices=m,
        noise=np.array([[1e-3]]),
        dt=DT,
        inputs=Layout([Signal(name=channel, unit="1")]),
        outputs=Layout([Signal(name=output, unit="rad/s")]),
        delays=(delay,),
        input_offset=np.array([0.2]),
        output_offset=np.array([0.1]),
    )


def mimo() -> LinearModel:
    """Two states, two channels with different delays, two outputs whose noise is correlated."""
    rng = np.random.default_rng(3)
    a = np.array([[0.9, 0.05], [-0.1, 0.8]])
    m = Matrices(
        a,
        rng.normal(size=(2, 2)),
        rng.normal(size=(2, 2)),
        np.zeros((2, 2)),
        0.1 * rng.normal(size=(2, 2)),
    )
    return body(m)


def body(matrices: Matrices) -> LinearModel:
    """A model of two channels with different delays and two outputs whose noise is correlated."""
    return LinearModel(
        name="body",
        matrices=matrices,
        noise=np.array([[4e-3, 1e-3], [1e-3, 9e-3]]),
        dt=DT,
        inputs=Layout([Signal(name="roll", unit="1"), Signal(name="pitch", unit="1")]),
        outputs=Layout([Signal(name="p", unit="rad/s"), Signal(name="q", unit="rad/s")]),
        delays=(1, 3),
        input_offset=np.array([0.1, -0.1]),
        output_offset=np.array([0.05, 0.0]),
    )


CHANNELS = {"roll": ((1.0, "u1"), (-1.0, "u2")), "pitch": ((1.0, "u1"), (1.0, "u2"))}


def hybrid(base: BasePredictor, features: tuple[str, ...], seed: int = 0) -> OutputHybrid:
    """A GP of these features on the errors of the base."""
    units = {s.name: s.unit for s in base.dynamics.outputs}
    outputs = Layout([Signal(name=n, unit=units[n]) for n in base.outputs])
    return OutputHybrid(base=base, posterior=posterior(layout_of(base, features), outputs, seed))


@functools.cache
def network(newest: int, increments: bool) -> LSTMModel:
    """An LSTM of two layers with random weights."""
    lags = Lags(outputs=("p", "q"), inputs=("u1", "u2"), n_a=2, n_b=3, newest=newest)
    rng = np.random.default_rng(6)
    size, width = 5, 4
    layers = tuple(
        (
            0.5 * rng.standard_normal((4 * size, d)),
            0.5 * rng.standard_normal((4 * size, size)),
            rng.standard_normal(4 * size),
        )
        for d in (width, size)
    )
    return LSTMModel(
        lags=lags,
        increments=increments,
        input_mean=np.full(lags.width, 0.1),
        input_scale=np.full(lags.width, 0.5),
        target_mean=np.zeros(2),
        target_scale=np.full(2, 0.1),
        layers=layers,
        head=(rng.standard_normal((2, size)), np.zeros(2)),
        variance=np.array([[1e-3, 2e-3], [3e-3, 4e-3]]),
        dt=DT,
    )


def narx(newest: int, increments: bool) -> NARXModel:
    """A GP on lags of different depth."""
    lags = Lags(outputs=("p", "q"), inputs=("u1", "u2"), n_a=2, n_b=2, newest=newest)
    return NARXModel(
        lags=lags,
        increments=increments,
        posterior=posterior(lags.layout, lags.output_layout, 2),
        dt=DT,
    )


def pieced() -> GaussianProcess:
    """A GP of a tree of covariances with two latent processes that three outputs mix."""
    rng = np.random.default_rng(7)
    kernel = Sum(
        parts=(
            Scaled(
                factor=0.7, inner=RationalQuadratic(lengthscales=np.array([1.0, 2.0]), alpha=1.5)
            ),
            OnDims(dims=(1,), inner=Linear(variances=np.array([0.2]))),
        )
    )
    support = rng.standard_normal((5, 2))
    latents = tuple(
        Latent(
            bases=(0,),
            prior=np.ones(1),
            weights=rng.standard_normal(5),
            explained=0.3 * np.tril(rng.standard_normal((5, 5))),
            uncertain=0.1 * rng.standard_normal((2, 5)),
            constant=0.3,
            slope=np.array([0.1, -0.2]),
        )
        for _ in range(2)
    )
    return GaussianProcess(
        inputs=Layout([Signal(name="a", unit="m"), Signal(name="b", unit="1")]),
        outputs=Layout([Signal(name=n, unit="N") for n in ("f", "g", "h")]),
        method="exact",
        bases=(Base(covariance=kernel, support=support),),
        latents=latents,
        mixing=rng.standard_normal((3, 2)),
        input_mean=np.array([0.2, -0.1]),
        input_scale=np.array([0.5, 2.0]),
        output_mean=np.array([1.0, 2.0, 3.0]),
        output_scale=np.array([0.5, 1.0, 2.0]),
        noise=np.full(3, 0.01),
        offset=np.zeros(3),
        domain=Domain(
            lower=-np.ones(2), upper=np.ones(2), distance=(0.1, 0.2, 0.3, 0.4), samples=5
        ),
    )


def axes() -> BasePredictor:
    """Two SISO models, one per axis."""
    model, channels = combined([siso("p", "roll"), siso("q", "pitch", 1)], CHANNELS)
    return LinearPredictor(model=model, outputs=("p", "q"), channels=channels)


PREDICTORS = {
    "linear, per axis": axes,
    "output hybrid, SISO": lambda: hybrid(
        LinearPredictor(model=siso(), outputs=("p",), channels=CHANNELS),
        ("p", "x1", "phi[t-1]", "u1[t-2]", "u2[t]"),
    ),
    "output hybrid, per axis": lambda: hybrid(axes(), ("p", "q", "phi[t-1]", "u1[t-1]")),
    "output hybrid, MIMO": lambda: hybrid(
        LinearPredictor(model=mimo(), outputs=("p", "q"), channels=CHANNELS),
        ("q", "u2[t-1]", "error.p[t-1]", "theta[t-2]"),
    ),
    "NARX": lambda: narx(1, False),
    "NARX of increments": lambda: narx(0, True),
    "LSTM": lambda: network(1, True),
    "LSTM with the newest command": lambda: network(0, False),
}
"""Those that predict channels of a flight."""
ALONE = {
    "GP alone": lambda: posterior(
        Layout([Signal(name="a", unit="m"), Signal(name="b", unit="1")]),
        Layout([Signal(name="f", unit="N")]),
    ),
    "GP of pieces": pieced,
}


def segment(seed: int = 1, n: int = 60) -> Segment:
    """A flight of plausible numbers; nothing in it follows any model."""
    rng = np.random.default_rng(seed)
    names = {"p": 0.5, "q": 0.5, "phi": 0.3, "theta": 0.3}
    columns = {
        k: s * np.convolve(rng.standard_normal(n + 4), np.ones(5) / 5, "valid")
        for k, s in names.items()
    }
    columns |= {k: rng.uniform(0, 1, n) for k in ("u1", "u2")}
    return dataset_from_arrays(DT * np.arange(n), columns, name="flight").segments[0]
