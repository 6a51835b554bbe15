"""How exact is the exported C of a Gaussian process, in double and in float, as its covariances
become ill-conditioned?

    python -m benchmarks.export_accuracy

SGPR on 3000 samples, 10 inputs, 2 outputs, 100 support points; length-scales between 1 and 2 times
`scale` (inputs have unit spread), noise variance as stated (the signal has unit size). Errors over
400 points, up to five times as far out as the data, each relative to the largest value of its
quantity; in float the inputs are rounded first for both.
"""

from __future__ import annotations

import ctypes
import json
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from greybox.residual import sparse
from greybox.residual.kernels import Kernel
from greybox.residual.posterior import Domain, GPPosterior
from greybox.symbolic import FloatArray, Layout, Signal
from mpc_export.c_code import FAST_FLAGS, Real, write_c
from mpc_export.c_kernels import GPKernel

RESULTS = Path(__file__).resolve().parent / "results"
QUANTITIES = ("mean", "variance", "mean_jacobian", "variance_jacobian")
CASES = ((2.0, 1e-2), (5.0, 1e-2), (10.0, 1e-3), (20.0, 1e-4))
INPUTS, OUTPUTS, POINTS, SAMPLES = 10, 2, 100, 3000


def trained(scale: float, noise: float) -> tuple[GPPosterior, float]:
    """The posterior, and the largest condition number of its covariance matrices."""
    rng = np.random.default_rng(0)
    x = rng.standard_normal((SAMPLES, INPUTS))
    kernels = [
        Kernel(family="se", lengthscales=rng.uniform(scale, 2 * scale, INPUTS), variance=1.0)
        for _ in range(OUTPUTS)
    ]
    columns = [
        np.sin(x[:, j]) + 0.3 * x[:, j + 1] + np.sqrt(noise) * rng.standard_normal(SAMPLES)
        for j in range(OUTPUTS)
    ]
    numbers = [sparse.collapsed(k, x[:POINTS].T, x.T, y, noise) for k, y in zip(kernels, columns)]
    gp = GPPosterior(
        inputs=Layout([Signal(name=f"z{i}", unit="-") for i in range(INPUTS)]),
        outputs=Layout([Signal(name=f"y{i}", unit="-") for i in range(OUTPUTS)]),
        method="sgpr",
        kernels=tuple(kernels),
        input_mean=np.zeros(INPUTS),
        input_scale=np.ones(INPUTS),
        output_mean=np.zeros(OUTPUTS),
        output_scale=np.ones(OUTPUTS),
        support=x[:POINTS],
        weights=np.stack([n.weights for n in numbers], axis=1),
        explained=np.stack([n.explained for n in numbers]),
        uncertain=np.stack([n.uncertain for n in numbers]),
        noise=np.full(OUTPUTS, noise),
        domain=Domain(lower=x.min(0), upper=x.max(0)),
    )
    return gp, max(float(np.linalg.cond(k.covariance(x[:POINTS].T, x[:POINTS].T))) for k in kernels)


def errors(gp: GPPosterior, real: Real) -> list[float]:
    """Per quantity the largest difference to the CasADi expressions over its largest value."""
    kernel = GPKernel(name="gp", posterior=gp, which=QUANTITIES)
    function = kernel.function()
    number: Any = ctypes.c_double if real == "double" else ctypes.c_float
    pointer, kind = ctypes.POINTER(number), np.dtype(number)
    with tempfile.TemporaryDirectory() as name:
        source = write_c([function], Path(name), prefix="m", real=real, kernels=[kernel])
        library = Path(name) / "m.so"
        subprocess.run(
            ["gcc", *FAST_FLAGS, "-fPIC", "-shared", "-o", str(library), str(source.source), "-lm"],
            check=True,
        )
        run, f = ctypes.CDLL(str(library)).m_gp, source.functions[0]
    worst, size, rng = np.zeros(4), np.zeros(4), np.random.default_rng(9)
    for _ in range(400):
        z = np.ascontiguousarray(
            (rng.standard_normal(INPUTS) * rng.choice([0.3, 1.0, 2.0, 5.0])).astype(np.float32),
            kind,
        )
        out: list[FloatArray] = [np.zeros(p.nnz, dtype=kind) for p in f.outputs]
        arg = (pointer * f.sz_arg)(z.ctypes.data_as(pointer))
        res = (pointer * f.sz_res)(*(o.ctypes.data_as(pointer) for o in out))
        assert run(arg, res, None, None, 0) == 0
        for i, (got, want) in enumerate(zip(out, function.call([z.astype(float)]))):
            expected = np.asarray(want).ravel(order="F")
            worst[i], size[i] = (
                max(worst[i], np.abs(got - expected).max()),
                max(size[i], np.abs(expected).max()),
            )
    return [float(v) for v in worst / size]


def main() -> None:
    rows = []
    for scale, noise in CASES:
        gp, condition = trained(scale, noise)
        row: dict[str, Any] = {
            "scale": scale,
            "noise_variance": noise,
            "condition": condition,
            "largest_weight": float(np.abs(gp.weights).max()),
        }
        reals: tuple[Real, ...] = ("double", "float")
        for real in reals:
            row[real] = dict(zip(QUANTITIES, errors(gp, real)))
        rows.append(row)
        print(row, flush=True)
    text = {"question": __doc__.splitlines()[0], "flags": " ".join(FAST_FLAGS), "rows": rows}
    (RESULTS / "export_accuracy.json").write_text(json.dumps(text, indent=1) + "\n")


if __name__ == "__main__":
    main()
