"""What does one evaluation of the GP cost inside an optimiser: our expressions against CasADi's own
derivatives, VM and C?

    python -m benchmarks.gp_evaluation

10 inputs, 6 outputs with kernels of their own (and once with a shared one), M = 50 and 100 support
points; microseconds per call through CasADi's buffer interface, CPU time, best of several runs, one
thread. "all": mean, variance, both Jacobians.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import casadi as ca  # noqa: E402 (after the thread counts)
import numpy as np  # noqa: E402

from greybox.estimation.build import build, compiler  # noqa: E402
from greybox.residual import sparse  # noqa: E402
from greybox.residual.kernels import Kernel  # noqa: E402
from greybox.residual.posterior import Domain, GPPosterior  # noqa: E402
from greybox.symbolic import Layout, Signal  # noqa: E402

RESULTS = Path(__file__).resolve().parent / "results"
WHICH = {
    "mean": ("mean",),
    "mean + Jacobian": ("mean", "mean_jacobian"),
    "mean, variance": ("mean", "variance"),
    "all": ("mean", "variance", "mean_jacobian", "variance_jacobian"),
}
INPUTS, OUTPUTS = 10, 6


def posterior(points: int, *, share: bool) -> GPPosterior:
    rng = np.random.default_rng(0)
    x = rng.standard_normal((1000, INPUTS))
    kernels = [
        Kernel(family="se", lengthscales=rng.uniform(2, 5, INPUTS), variance=1.0)
        for _ in range(OUTPUTS)
    ]
    kernels = [kernels[0]] * OUTPUTS if share else kernels
    y = np.stack(
        [np.sin(x[:, j]) + 0.1 * rng.standard_normal(1000) for j in range(OUTPUTS)], axis=1
    )
    numbers = [sparse.collapsed(k, x[:points].T, x.T, y[:, j], 0.01) for j, k in enumerate(kernels)]
    return GPPosterior(
        inputs=Layout([Signal(name=f"z{i}", unit="-") for i in range(INPUTS)]),
        outputs=Layout([Signal(name=f"y{i}", unit="-") for i in range(OUTPUTS)]),
        method="sgpr",
        kernels=tuple(kernels),
        input_mean=np.zeros(INPUTS),
        input_scale=np.ones(INPUTS),
        output_mean=np.zeros(OUTPUTS),
        output_scale=np.ones(OUTPUTS),
        support=x[:points],
        weights=np.stack([n.weights for n in numbers], axis=1),
        explained=np.stack([n.explained for n in numbers]),
        uncertain=np.stack([n.uncertain for n in numbers]),
        noise=np.full(OUTPUTS, 0.01),
        domain=Domain(lower=x.min(0), upper=x.max(0)),
    )


def by_ad(gp: GPPosterior, which: Sequence[str]) -> Any:
    """The same quantities with CasADi's own Jacobians of mean and variance."""
    z = ca.MX.sym("z", INPUTS)
    values = gp.expressions(z, {n.removesuffix("_jacobian") for n in which})
    out = [
        ca.jacobian(values[n.removesuffix("_jacobian")], z) if n.endswith("jacobian") else values[n]
        for n in which
    ]
    return ca.Function("gp_ad", [z], out)


def compiled(function: Any) -> Any:
    generator = ca.CodeGenerator(f"{function.name()}.c")
    generator.add(function)
    library = build(
        [(f"{function.name()}.c", generator.dump(), ("-O3", "-march=native", "-fPIC", "-w"))]
    )
    return ca.external(function.name(), str(library))


def microseconds(function: Any) -> float:
    z = np.random.default_rng(1).standard_normal(INPUTS)
    buffer, run = function.buffer()
    buffer.set_arg(0, memoryview(z))
    results = [np.zeros(function.nnz_out(i)) for i in range(function.n_out())]
    for i, r in enumerate(results):
        buffer.set_res(i, memoryview(r))
    run()
    best, calls = float("inf"), 200
    for _ in range(15):
        start = time.process_time()
        for _ in range(calls):
            run()
        best = min(best, (time.process_time() - start) / calls)
    return round(1e6 * best, 2)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--out", type=Path, default=RESULTS / "gp_evaluation.json", metavar="F.json"
    )
    options = parser.parse_args()
    rows = []
    for points in (50, 100):
        for share in (False, True):
            gp = posterior(points, share=share)
            for name, which in WHICH.items():
                ours = gp.function("gp_ours", which)
                row: dict[str, Any] = {
                    "points": points,
                    "shared_kernel": share,
                    "quantities": name,
                    "vm": microseconds(ours),
                }
                with_ad = by_ad(gp, which) if "jacobian" in " ".join(which) else None
                row["vm_ad"] = microseconds(with_ad) if with_ad else None
                if compiler() is not None:
                    row["c"] = microseconds(compiled(ours))
                    row["c_ad"] = microseconds(compiled(with_ad)) if with_ad else None
                rows.append(row)
                print(row, flush=True)
    text = {
        "question": __doc__.splitlines()[0],
        "unit": "us",
        "machine": platform.machine(),
        "rows": rows,
    }
    options.out.write_text(json.dumps(text, indent=1) + "\n")


if __name__ == "__main__":
    main()
