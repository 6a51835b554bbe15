"""How fast does the residual GP train, against Adam on the exact GP at the same likelihood, and at
100 000 samples?

One BLAS and PyTorch thread. Each row in a process of its own, so that its peak memory is its own.

    python -m benchmarks.gp_training [--only exact,large,svgp] [--cap 40]

`exact`: one output, N = 3000, 10 inputs. `train_gp` (hold_out=0) runs as users get it; its
hyper-parameters are judged by the exact log marginal likelihood of all 3000 samples. Adam (step
0.1, GPyTorch's defaults, exact Cholesky) then climbs that likelihood and stops when it is as high,
or at `--cap` times our time. `large`, `svgp`: N = 100 000, six outputs, M = 100.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import numpy as np  # noqa: E402 (after the thread counts)

RESULTS = Path(__file__).resolve().parent / "results"


def flight_like(n: int, outputs: int, seed: int = 0) -> tuple[Any, Any]:
    """(Z (n, 10), Y (n, outputs)): sums of sines, curved functions of a few of them, white
    noise."""
    rng = np.random.default_rng(seed)
    t = 0.01 * np.arange(n)
    waves = [zip(rng.uniform(0.1, 3, 4), rng.uniform(0, 6.3, 4)) for _ in range(10)]
    z = np.stack([sum(np.sin(2 * np.pi * f * t + p) for f, p in wave) for wave in waves], axis=1)
    s = z / z.std(0)
    f = np.stack(
        [
            np.tanh(s[:, 0]) * s[:, 1],
            0.5 * np.abs(s[:, 2]) * s[:, 2],
            np.sin(s[:, 3] + 0.5 * s[:, 4]),
            np.cos(s[:, 6]) * s[:, 7],
            0.3 * s[:, 5],
            np.tanh(s[:, 8] + s[:, 9]),
        ],
        axis=1,
    )
    return z, (f + 0.2 * rng.standard_normal(f.shape))[:, :outputs]


def layout(prefix: str, n: int) -> Any:
    from greybox.symbolic import Layout, Signal

    return Layout([Signal(name=f"{prefix}{i}", unit="-") for i in range(n)])


def against_adam(cap: float) -> dict[str, Any]:
    import gpytorch
    import torch

    from greybox.residual import sparse
    from greybox.residual.torch_gp import ExactModel
    from greybox.residual.train import train_gp

    torch.set_num_threads(1)
    z, y = flight_like(3000, 1)
    warm = slice(0, 200)
    train_gp(
        z[warm],
        y[warm],
        inputs=layout("z", 10),
        outputs=layout("y", 1),
        points=20,
        hold_out=0,
        restarts=1,
    )
    start = time.perf_counter()
    trained = train_gp(z, y, inputs=layout("z", 10), outputs=layout("y", 1), points=100, hold_out=0)
    ours = time.perf_counter() - start
    p = trained.posterior
    x, target = (z - p.input_mean) / p.input_scale, (y[:, 0] - p.output_mean[0]) / p.output_scale[0]
    noise = float(p.noise[0] / p.output_scale[0] ** 2)
    level = sparse.exact(p.kernels[0], x.T, target, noise).log_likelihood
    assert level is not None
    likelihood = gpytorch.likelihoods.GaussianLikelihood().double()
    covariance = gpytorch.kernels.ScaleKernel(gpytorch.kernels.RBFKernel(ard_num_dims=10)).double()
    inputs = torch.tensor(x)
    model = ExactModel(inputs, torch.tensor(target), likelihood, covariance).double()
    model.train(), likelihood.train()
    mll = gpytorch.mlls.ExactMarginalLogLikelihood(likelihood, model)
    optimiser = torch.optim.Adam(model.parameters(), lr=0.1)
    values: list[float] = []
    start, reached = time.perf_counter(), False
    with gpytorch.settings.fast_computations(False, False, False):
        while time.perf_counter() - start < cap * ours:
            optimiser.zero_grad()
            loss = -mll(model(inputs), model.train_targets)
            values.append(-loss.item() * len(x))
            if values[-1] >= level:
                reached = True
                break
            loss.backward()
            optimiser.step()
    adam = time.perf_counter() - start
    return {
        "samples": 3000,
        "inputs": 10,
        "our_seconds": ours,
        "our_status": trained.report.outputs[0].status,
        "log_likelihood": level,
        "adam_seconds": adam,
        "adam_reached_it": reached,
        "adam_evaluations": len(values),
        "adam_log_likelihood": max(values),
        "ratio": adam / ours,
        "ratio_is_a_lower_bound": not reached,
    }


def large(method: str) -> dict[str, Any]:
    from greybox.residual.train import train_gp

    z, y = flight_like(100_000, 6)
    start = time.perf_counter()
    trained = train_gp(
        z,
        y,
        inputs=layout("z", 10),
        outputs=layout("y", 6),
        points=100,
        groups=np.repeat(range(25), 4000),
        method=method,
    )
    seconds = time.perf_counter() - start
    return {
        "samples": 100_000,
        "outputs": 6,
        "points": trained.posterior.points,
        "method": method,
        "seconds": seconds,
        "statuses": [o.status for o in trained.report.outputs],
        "noise_std": [o.noise_std for o in trained.report.outputs],
        "peak_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", default="exact,large,svgp")
    parser.add_argument("--cap", type=float, default=40.0)
    parser.add_argument("--row", help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.row:
        rows = {
            "exact": lambda: against_adam(chosen.cap),
            "large": lambda: large("sgpr"),
            "svgp": lambda: large("svgp"),
        }
        print(json.dumps(rows[chosen.row]()))
        return
    path = RESULTS / "gp_training.json"
    result: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
    for row in chosen.only.split(","):
        command = [
            sys.executable,
            "-m",
            "benchmarks.gp_training",
            "--row",
            row,
            "--cap",
            str(chosen.cap),
        ]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        result[row] = json.loads(done.stdout.splitlines()[-1])
        print(row, json.dumps(result[row], indent=1))
    result = {
        "question": __doc__.splitlines()[0],
        "machine": platform.processor() or platform.machine(),
        **result,
    }
    path.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
