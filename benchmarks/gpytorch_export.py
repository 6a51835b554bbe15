"""What does a GP that was trained in GPyTorch cost per call once it is CasADi or C?

    python -m benchmarks.gpytorch_export [--points 100] [--inputs 10] [--l4casadi-python
    OTHER/bin/python]

Mean and its Jacobian at one point, one output, in microseconds: GPyTorch itself (caches warm,
autograd), l4casadi (float32; its own environment), `from_gpytorch` in CasADi's virtual machine and
as compiled C.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import casadi as ca  # noqa: E402 (after the thread counts)
import gpytorch  # noqa: E402
import numpy as np  # noqa: E402
import torch  # noqa: E402

from greybox.residual.from_gpytorch import from_gpytorch  # noqa: E402
from mpc_export.c_code import FAST_FLAGS, write_c  # noqa: E402

torch.set_num_threads(1)
HERE = Path(__file__).parent


class Model(gpytorch.models.ExactGP):
    def __init__(self, x: torch.Tensor, y: torch.Tensor, likelihood: gpytorch.Module) -> None:
        super().__init__(x, y, likelihood)
        self.mean_module = gpytorch.means.ConstantMean()
        kernel = gpytorch.kernels.RBFKernel(ard_num_dims=x.shape[1])
        self.covar_module = gpytorch.kernels.ScaleKernel(kernel)

    def forward(self, x: torch.Tensor) -> gpytorch.distributions.MultivariateNormal:
        return gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))


def made(points: int, inputs: int) -> tuple[Model, gpytorch.likelihoods.GaussianLikelihood]:
    torch.manual_seed(0)
    x = torch.randn(points, inputs, dtype=torch.float64)
    likelihood = gpytorch.likelihoods.GaussianLikelihood().double()
    model = Model(
        x, torch.sin(x[:, 0]) + 0.1 * torch.randn(points, dtype=torch.float64), likelihood
    )
    model = model.double()
    model.covar_module.base_kernel.lengthscale = 2.0
    return model.eval(), likelihood.eval()


TURNS = 21
Call = Callable[[], object]
ALIVE: list[object] = []
"""What C functions read and write."""


def in_torch(model: Model, z: np.ndarray) -> Call:
    """Mean and gradient."""
    point = torch.tensor(z[None], requires_grad=True)
    return lambda: torch.autograd.grad(model(point).mean.sum(), point)


def called(function: ca.Function, z: np.ndarray) -> Call:
    """A CasADi function, through its buffers."""
    buffer, run = function.buffer()
    sent = np.ascontiguousarray(z)
    buffer.set_arg(0, memoryview(sent))
    kept = [np.zeros(function.nnz_out(i)) for i in range(function.n_out())]
    for i, result in enumerate(kept):
        buffer.set_res(i, memoryview(result))
    ALIVE.append((buffer, sent, kept))
    return run


def in_turns(calls: Mapping[str, tuple[Call, int]]) -> dict[str, float]:
    """Median CPU microseconds of each, so many calls a turn, all in every turn: what else the
    machine does hits them alike. The first turn warms up."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(TURNS + 1):
        for name, (call, count) in calls.items():
            start = time.process_time()
            for _ in range(count):
                call()
            times[name].append((time.process_time() - start) / count)
    return {name: 1e6 * float(np.median(found[1:])) for name, found in times.items()}


def compiled(function: ca.Function, folder: Path) -> ca.Function:
    """The same function from C with the fast flags."""
    source = write_c([function], folder, prefix="bench")
    library = folder / "bench.so"
    command = [
        "gcc",
        *FAST_FLAGS,
        "-shared",
        "-fPIC",
        str(source.source),
        "-o",
        str(library),
        "-lm",
    ]
    subprocess.run(command, check=True)
    return ca.external(f"bench_{function.name()}", str(library))


def other(python: str | None, model: Model, z: np.ndarray, folder: Path) -> float | None:
    """Microseconds of l4casadi for the same mean and Jacobian, in its own environment."""
    if python is None:
        return None
    model(torch.tensor(z[None]))
    support = model.train_inputs[0].numpy()
    kernel = model.covar_module
    lengthscale = kernel.base_kernel.lengthscale.detach().numpy().ravel()
    weights = model.prediction_strategy.mean_cache.detach().numpy() * float(kernel.outputscale)
    k = np.exp(-0.5 * (((z - support) / lengthscale) ** 2).sum(1))
    slope = -(weights * k) @ ((z - support) / lengthscale**2)
    np.savez(
        folder / "numbers.npz",
        support=support,
        inverse=lengthscale[None] ** -2.0,
        weights=weights[:, None],
        z=z,
        mean=np.array([[weights @ k]]),
        jacobian=slope[None],
    )
    build = folder / "l4casadi"
    build.mkdir()
    script = [
        python,
        "-W",
        "ignore",
        str(HERE / "export_l4casadi.py"),
        str(folder / "numbers.npz"),
        str(build),
    ]
    done = subprocess.run(script, capture_output=True, text=True, check=False)
    if done.returncode:
        print(f"l4casadi: {done.stderr.strip().splitlines()[-1]}")
        return None
    return float(json.loads(done.stdout.strip().splitlines()[-1])["mean_jacobian"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=100)
    parser.add_argument("--inputs", type=int, default=10)
    parser.add_argument("--l4casadi-python", help="interpreter of an environment that has l4casadi")
    parser.add_argument("--out", type=Path, metavar="F.json", help="also write the times [us]")
    options = parser.parse_args()
    model, likelihood = made(options.points, options.inputs)
    z = np.random.default_rng(1).standard_normal(options.inputs)
    start = time.perf_counter()
    gp = from_gpytorch(model, likelihood)
    seconds = time.perf_counter() - start
    function = gp.function("both", ("mean", "mean_jacobian"))
    everything = gp.function("all", ("mean", "variance", "mean_jacobian", "variance_jacobian"))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        c, more = (
            called(compiled(f, folder / name), z)
            for f, name in ((function, "a"), (everything, "b"))
        )
        rows: dict[str, float | None] = {
            **in_turns(
                {
                    "GPyTorch, autograd": (in_torch(model, z), 5),
                    "from_gpytorch, CasADi VM": (called(function, z), 2000),
                    "from_gpytorch, C": (c, 2000),
                    "from_gpytorch, C, with variance and its Jacobian": (more, 2000),
                }
            ),
            "l4casadi, float32, VM": other(options.l4casadi_python, model, z, folder),
        }
    best = rows["from_gpytorch, C"]
    print(
        f"{options.points} training points, {options.inputs} inputs; read and checked in "
        f"{seconds:.2f} s"
    )
    for label, value in rows.items():
        print(
            f"{label:50s} "
            + ("not run" if value is None else f"{value:10.2f} us {value / best:8.1f} x")
        )
    if options.out:
        options.out.write_text(json.dumps({"microseconds": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
