"""NARXModel: a Gaussian process alone on past outputs and inputs, the baseline that knows no
physics.

y[t] = f(y[t-1], ..., y[t-n_a], u[t-1], ..., u[t-n_b]) + e with one GP per output (Rasmussen and
Williams 2006, ch. 2; as a dynamic model: Kocijan 2016, Modelling and Control of Dynamic Systems
Using Gaussian Process Models, ch. 2). In a free run the predictions take the place of the outputs
not yet measured, and their covariance is carried along by the Jacobian of the mean (first order:
Girard et al. 2003, NIPS 15; the GP's own errors count as independent from step to step).
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TypedDict

import casadi as ca
import numpy as np
import numpy.typing as npt

from greybox.baselines.regressors import Choice, Data, Lags, Space, segments_of
from greybox.data import Segment
from greybox.errors import FileFormatError, ModelError
from greybox.files import checksum, read_json, to_plain, well_formed, write_json
from greybox.residual.posterior import GPPosterior
from greybox.residual.training_report import TrainingDocument
from greybox.symbolic import FloatArray, evaluate

SCHEMA = "greybox.narx/1"
CHUNK = 4096
"""Origins that are rolled out at once (bounds the memory)."""
SPACE: Space = {
    "lags": (2, 4),
    "kernel": ("se", "matern52"),
    "increments": (False, True),
    "points": (100, 200),
}
"""What the search draws from; `lags` sets n_a and n_b."""


class NARXReport(TypedDict, total=False):
    """How a NARX model was trained and, of a search, all candidates; empty where nobody said."""

    settings: dict[str, Choice]
    seed: int
    samples: int
    training: TrainingDocument
    search: list[dict[str, Choice]]


@dataclass(frozen=True, kw_only=True, eq=False)
class NARXModel:
    """A GP over `lags`; with `increments` it predicts y[t] - y[t-1]; `dt` [s] is the training
    data's sample time. Plain numbers, no torch. Raises `ModelError`."""

    lags: Lags
    increments: bool
    posterior: GPPosterior
    train_seconds: float = 0.0
    report: NARXReport = field(default_factory=NARXReport)
    dt: float | None = None

    def __post_init__(self) -> None:
        if (
            self.posterior.inputs.names != self.lags.layout.names
            or self.posterior.outputs.names != self.lags.outputs
        ):
            raise ModelError(
                "the GP is not one over these lags", expected=", ".join(self.lags.layout.names)
            )

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the predicted channels."""
        return self.lags.outputs

    @property
    def parameters(self) -> int:
        """Hyper-parameters, support points and weights."""
        gp = self.posterior
        kernels = {id(k): k for k in gp.kernels}
        return (
            sum(len(k.lengthscales) + 1 for k in kernels.values())
            + gp.noise.size
            + gp.support.size
            + gp.weights.size
        )

    def one_step(self, segment: Segment) -> tuple[FloatArray, FloatArray]:
        """Mean and variance (n, n_y) of every measured sample, noise included; NaN where the past
        has a hole."""
        z = self.lags.rows(segment)
        whole = np.isfinite(z).all(axis=1)
        mean, variance = np.full((2, len(z), len(self.outputs)), np.nan)
        mean[whole], variance[whole] = self.posterior.evaluate(z[whole], noise=True)
        if self.increments:
            mean += z[:, : len(self.outputs)]
        return mean, variance

    def free_run(
        self, segment: Segment, origins: npt.ArrayLike, horizon: int
    ) -> tuple[FloatArray, FloatArray]:
        """Mean and variance (m, horizon, n_y), noise included, the covariance of past predictions
        carried along."""
        past, moved = self.lags.starts(segment, origins, horizon)
        parts = [
            self._run(past[at : at + CHUNK], moved[at : at + CHUNK])
            for at in range(0, max(len(past), 1), CHUNK)
        ]
        return np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts])

    def _run(self, past: FloatArray, moved: FloatArray) -> tuple[FloatArray, FloatArray]:
        m, horizon = moved.shape[:2]
        n_y, n_p = len(self.outputs), past.shape[1]
        mean, variance = np.full((2, m, horizon, n_y), np.nan)
        covariance = np.zeros((m, n_p, n_p))
        noise = self.posterior.noise_variance(True)
        for h in range(horizon):
            z = Lags.joined(past, moved[:, h])
            whole = np.flatnonzero(np.isfinite(z).all(axis=1))
            if not whole.size:
                break
            told = evaluate(self._told, z[whole])
            new = np.full((m, n_y), np.nan)
            new[whole] = told[:, :n_y] + (z[whole, :n_y] if self.increments else 0.0)
            slope = told[:, 2 * n_y :].reshape(-1, n_p, n_y).swapaxes(1, 2)
            if self.increments:
                slope = slope + np.eye(n_y, n_p)
            before = covariance[whole]
            cross = slope @ before
            spread = cross @ slope.swapaxes(1, 2)
            at = np.arange(n_y)
            spread[:, at, at] += told[:, n_y : 2 * n_y] + noise
            after = np.empty_like(before)
            after[:, :n_y, :n_y] = spread
            after[:, :n_y, n_y:] = cross[:, :, : n_p - n_y]
            after[:, n_y:, :n_y] = cross[:, :, : n_p - n_y].swapaxes(1, 2)
            after[:, n_y:, n_y:] = before[:, : n_p - n_y, : n_p - n_y]
            covariance[whole] = after
            mean[whole, h], variance[whole, h] = new[whole], spread[:, at, at]
            past = self.lags.pushed(past, new)
        return mean, variance

    @cached_property
    def _told(self) -> ca.Function:
        """z -> (mean, variance of the function, d mean / d past outputs column by column) in one
        vector."""
        z = ca.MX.sym("z", self.lags.width)
        told = self.posterior.expressions(z, ("mean", "variance", "mean_jacobian"))
        past = told["mean_jacobian"][:, : self.lags.n_a * len(self.outputs)]
        return ca.Function(
            "told", [z], [ca.densify(ca.vertcat(told["mean"], told["variance"], ca.vec(past)))]
        )

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write one JSON file, atomically."""
        body = to_plain(
            {
                "schema": SCHEMA,
                "lags": {f: getattr(self.lags, f) for f in Lags.__dataclass_fields__},
                "increments": self.increments,
                "dt": self.dt,
                "train_seconds": self.train_seconds,
                "report": {**self.report},
                "posterior": self.posterior.to_dict(),
            }
        )
        return write_json(path, {**body, "checksum": checksum(body)})

    @staticmethod
    def load(path: str | os.PathLike[str]) -> NARXModel:
        """Read what `save` wrote. Raises `FileFormatError`."""
        body = read_json(path, schema=SCHEMA)
        if body.pop("checksum", None) != checksum(body):
            raise FileFormatError(
                "the checksum does not fit", where=str(path), fix="train again; do not edit by hand"
            )
        with well_formed(str(path), fix="train again"):
            return NARXModel(
                lags=Lags(**body["lags"]),
                increments=bool(body["increments"]),
                posterior=GPPosterior.from_dict(body["posterior"]),
                train_seconds=float(body["train_seconds"]),
                report=body["report"],
                dt=body.get("dt"),
            )


def fit_narx(
    train: Data,
    *,
    outputs: Sequence[str],
    inputs: Sequence[str],
    n_a: int = 4,
    n_b: int = 4,
    newest: int = 1,
    increments: bool = False,
    kernel: str = "se",
    points: int = 100,
    seed: int = 0,
) -> NARXModel:
    """A sparse GP (SGPR) on the regressors of `train`. Raises `DataError`."""
    from greybox.residual.train import train_gp

    began = time.perf_counter()
    lags = Lags(outputs=tuple(outputs), inputs=tuple(inputs), n_a=n_a, n_b=n_b, newest=newest)
    z, y, flights = lags.pairs(segments_of(train))
    target = y - z[:, : len(lags.outputs)] if increments else y
    trained = train_gp(
        z,
        target,
        inputs=lags.layout,
        outputs=lags.output_layout,
        kernel=kernel,
        points=points,
        seed=seed,
        groups=flights,
        hold_out=0.0,
        noise_inflation=1.0,
        prior_mean="constant",
    )
    settings: dict[str, Choice] = {
        "n_a": n_a,
        "n_b": n_b,
        "newest": newest,
        "increments": increments,
        "kernel": kernel,
        "points": points,
    }
    return NARXModel(
        lags=lags,
        increments=increments,
        posterior=trained.posterior,
        train_seconds=time.perf_counter() - began,
        report={
            "settings": settings,
            "seed": seed,
            "samples": len(z),
            "training": trained.report.to_dict(),
        },
        dt=segments_of(train)[0].dt,
    )
