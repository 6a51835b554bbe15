"""Do 50 or 100 support points keep what the full Gaussian process knows, on residuals as they come?

Residuals are one-step errors of fitted models: simulated ones of the nonlinear model of the paper's
experiment, real ones of decoupled linear models on the NanoBench flights (nine to train on, five
others to judge). Full and sparse processes get the same hyper-parameters (`train_gp` with one
seed). Printed per output and number of points: RMSE on the held-out residuals over that of the full
process, and the smallest ratio of the variances without noise.

    python -m scenarios.studies.sparse_residuals [--rows 1500] [--seeds 2] [--points 50 100] [--out
    FILE]
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from greybox.baselines.base_predictor import BasePredictor
from greybox.baselines.decoupled import Terms, combined
from greybox.baselines.filter_predictor import FilterPredictor
from greybox.baselines.linear_predictor import LinearPredictor
from greybox.baselines.output_residual import output_features, residual_rows
from greybox.baselines.predictor_features import layout_of
from greybox.data import Dataset
from greybox.data.logs import read_logs
from greybox.examples import NANOBENCH_TEST, NANOBENCH_TRAIN, flight_paths, vehicle_path
from greybox.files import write_json
from greybox.linear.fit import fit_linear
from greybox.linear.records import Record
from greybox.model.linear import LinearModel
from greybox.model.vehicle import read_vehicle
from greybox.residual.posterior import GPPosterior
from greybox.residual.selection import stratified
from greybox.residual.train import train_gp
from greybox.symbolic import FloatArray, Layout, Signal
from scenarios.studies.paper_data import COMMANDS, DT, OUTPUTS, TEST, TRAIN, paper_data
from scenarios.studies.paper_methods import Bench

ORDER = 3
"""Order of the linear models: what they miss is what is looked at here."""
PAIRS = {"p": "roll", "q": "pitch", "r": "yaw", "ax": "pitch", "ay": "roll", "az": "collective"}
SIGNS = {
    "roll": (-1, -1, 1, 1),
    "pitch": (-1, 1, 1, -1),
    "yaw": (-1, 1, -1, 1),
    "collective": (1, 1, 1, 1),
}
"""Weights of m1 front right, m2 rear right, m3 rear left, m4 front left."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Residuals:
    """Features (N, n_z), residuals (N, n_o) and flights to train on, features and residuals to
    judge."""

    name: str
    inputs: Layout
    outputs: Layout
    train: tuple[FloatArray, FloatArray, Any]
    test: tuple[FloatArray, FloatArray]


def _thinned(
    name: str, base: BasePredictor, train: Dataset, test: Dataset, rows: int, seed: int
) -> Residuals:
    features = output_features(base, train.channels)
    z, r, flights = residual_rows(base, train, features)
    few = stratified(np.unique(flights, return_inverse=True)[1], rows, seed)
    z_test, r_test, _ = residual_rows(base, test, features)
    some = slice(None, None, -(-len(z_test) // rows))
    units = {s.name: s.unit for s in base.dynamics.outputs}
    return Residuals(
        name=name,
        inputs=layout_of(base, features),
        outputs=Layout([Signal(name=n, unit=units[n]) for n in base.outputs]),
        train=(z[few], r[few], flights[few]),
        test=(z_test[some], r_test[some]),
    )


def simulated(seeds: int, rows: int) -> Iterator[Residuals]:
    """Of the nonlinear model on the record of each seed: 0-20 s and 25-30 s."""
    for seed in range(seeds):
        data = paper_data(seed)
        base = FilterPredictor(model=Bench(data=data).physics.model, outputs=OUTPUTS)
        yield _thinned(f"simulated {seed}", base, data.part(TRAIN), data.part(TEST), rows, seed)


def real(rows: int) -> Residuals:
    """Of decoupled linear models on NanoBench flights."""
    vehicle = read_vehicle(vehicle_path("nanobench"))
    data = read_logs(flight_paths("nanobench"), vehicle)
    train, test = data.select(NANOBENCH_TRAIN), data.select(NANOBENCH_TEST)
    models: list[LinearModel] = []
    for name, axis in PAIRS.items():
        records = [
            Record(
                u=s.matrix(COMMANDS) @ np.array([SIGNS[axis]]).T, y=s.matrix((name,)), name=s.flight
            )
            for s in train.segments
        ]
        found = fit_linear(records, ORDER, dt=DT, inputs=(axis,), outputs=(name,), delays=(1,))
        models.append(found.model)
    mixes: dict[str, Terms] = {
        a: tuple(zip(map(float, w), COMMANDS, strict=True)) for a, w in SIGNS.items()
    }
    model, channels = combined(models, mixes)
    return _thinned(
        "NanoBench", LinearPredictor(model=model, channels=channels), train, test, rows, 0
    )


def moments(posterior: GPPosterior, z: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean and variance without noise (N, n_o), in standardised outputs; NumPy, for the full
    process is large."""
    x = ((z - posterior.input_mean) / posterior.input_scale).T
    mean, variance = np.zeros((2, x.shape[1], len(posterior.outputs)))
    for j, kernel in enumerate(posterior.kernels):
        k = kernel.covariance(posterior.support.T, x)
        left = np.maximum(
            kernel.prior_variance(x).ravel() - ((posterior.explained[j] @ k) ** 2).sum(0), 0.0
        )
        mean[:, j] = posterior.weights[:, j] @ k
        factor = posterior.variance_factor[j] if posterior.variance_factor else 1.0
        variance[:, j] = factor * (left + ((posterior.uncertain[j] @ k) ** 2).sum(0))
    return mean, variance


def judged(set_: Residuals, points: Sequence[int], seed: int = 0) -> list[dict[str, Any]]:
    """One row per output and number of points."""

    def trained(method: str, m: int) -> GPPosterior:
        z, r, flights = set_.train
        return train_gp(
            z,
            r,
            inputs=set_.inputs,
            outputs=set_.outputs,
            method=method,
            points=m,
            groups=flights,
            hold_out=0.0,
            noise_inflation=1.0,
            guard=True,
            seed=seed,
        ).posterior

    z, r = set_.test
    full = trained("exact", 1)
    y = r / full.output_scale
    whole, spread = moments(full, z)
    rows = []
    for m in points:
        few, variance = moments(trained("sgpr", m), z)
        for j, name in enumerate(set_.outputs.names):
            error, best = (float(np.sqrt(np.mean((y[:, j] - v[:, j]) ** 2))) for v in (few, whole))
            rows.append(
                {
                    "residuals": set_.name,
                    "output": name,
                    "points": m,
                    "rmse": error,
                    "rmse_full": best,
                    "rmse_nothing": float(np.sqrt(np.mean(y[:, j] ** 2))),
                    "ratio": error / best,
                    "variance": float((variance[:, j] / spread[:, j]).min()),
                }
            )
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """Run and print the study."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rows", type=int, default=1500, help="rows of each training and test set")
    parser.add_argument("--seeds", type=int, default=2, help="simulated records")
    parser.add_argument("--points", type=int, nargs="+", default=[50, 100])
    parser.add_argument("--out", metavar="FILE")
    options = parser.parse_args(arguments)
    rows: list[dict[str, Any]] = []
    for set_ in itertools.chain([real(options.rows)], simulated(options.seeds, options.rows)):
        found = judged(set_, options.points)
        rows += found
        for row in found:
            print(
                f"{row['residuals']:12s} {row['output']:3s} M = {row['points']:3d}: RMSE "
                f"{row['rmse']:.4f}, full {row['rmse_full']:.4f} (without a GP "
                f"{row['rmse_nothing']:.4f}), ratio {row['ratio']:.4f}, least variance ratio "
                f"{row['variance']:.3f}",
                flush=True,
            )
    for m in options.points:
        ratios = [row["ratio"] for row in rows if row["points"] == m]
        least = min(row["variance"] for row in rows if row["points"] == m)
        print(
            f"M = {m}: ratio of RMSE {np.median(ratios):.3f} (median), {max(ratios):.3f} (worst); "
            f"variance {least:.3f}"
        )
    if options.out:
        write_json(options.out, {"schema": "greybox.sparse_residuals/1", "rows": rows})


if __name__ == "__main__":
    main()
