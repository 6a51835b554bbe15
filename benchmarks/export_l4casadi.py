"""Times one Gaussian process in l4casadi, for export_speed.py, which runs this with an interpreter
that has l4casadi.

    L4CASADI_PYTHON benchmarks/export_l4casadi.py NUMBERS.npz BUILD_DIR

Prints JSON: microseconds of mean and of mean + Jacobian per call in CasADi's VM (l4casadi computes
in float32).
"""

from __future__ import annotations

import json
import os
import sys
import time

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import casadi as ca  # noqa: E402 (after the thread counts)
import l4casadi as l4c  # noqa: E402
import numpy as np  # noqa: E402
import torch  # noqa: E402

torch.set_num_threads(1)


class Predictor(torch.nn.Module):
    """The mean in plain tensors, all outputs at once: a favour, its users would write GPyTorch."""

    def __init__(self, support: np.ndarray, inverse: np.ndarray, weights: np.ndarray) -> None:
        super().__init__()
        tensor = lambda v: torch.tensor(v, dtype=torch.float32)  # noqa: E731
        self.scaled = torch.nn.Parameter(
            tensor(support[None] * np.sqrt(inverse)[:, None])
        )  # (O, M, D)
        self.root = torch.nn.Parameter(tensor(np.sqrt(inverse)))
        self.weights = torch.nn.Parameter(tensor(weights.T))

    def forward(self, z: torch.Tensor) -> torch.Tensor:
        x = z.reshape(1, 1, -1) * self.root[:, None]
        k = torch.exp(-0.5 * ((x - self.scaled) ** 2).sum(-1))
        return (self.weights * k).sum(-1).reshape(1, -1)


def microseconds(function: ca.Function, z: np.ndarray) -> float:
    buffer, run = function.buffer()
    buffer.set_arg(0, memoryview(z))
    for i in range(function.n_out()):
        buffer.set_res(i, memoryview(np.zeros(function.nnz_out(i))))
    times = []
    for _ in range(21):
        start = time.process_time()
        for _ in range(50):
            run()
        times.append((time.process_time() - start) / 50)
    return 1e6 * float(np.median(times[1:]))


def main() -> None:
    numbers, folder = np.load(sys.argv[1]), sys.argv[2]
    os.chdir(folder)
    model = Predictor(numbers["support"], numbers["inverse"], numbers["weights"])
    with torch.no_grad():
        learned = l4c.L4CasADi(
            model, device="cpu", name="gp_mean", generate_adj1=False, generate_jac_adj1=False
        )
    z = ca.MX.sym("z", numbers["support"].shape[1], 1)
    mean = learned(z.T).T
    with_slope = ca.Function("both", [z], [mean, ca.jacobian(mean, z)])
    point = np.ascontiguousarray(numbers["z"])
    got = with_slope(point)
    out = {
        "mean": microseconds(ca.Function("mean", [z], [mean]), point),
        "mean_jacobian": microseconds(with_slope, point),
        "largest_error": [
            float(np.abs(np.asarray(g) - numbers[n]).max())
            for g, n in zip(got, ("mean", "jacobian"))
        ],
        "version": l4c.__version__ if hasattr(l4c, "__version__") else "2",
    }
    print(json.dumps(out))


if __name__ == "__main__":
    main()
