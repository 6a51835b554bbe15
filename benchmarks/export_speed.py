"""How fast is what we export, the GP and RK4 with Jacobians, against hand-written SIMD, CasADi,
l4casadi and GPyTorch?

    python -m benchmarks.export_speed [--l4casadi-python OTHER/bin/python] [--points 100]

10 inputs, 6 outputs with length-scales of their own. All C is compiled by one compiler with the
flags printed, called from one C loop; the candidates take turns, every figure is the median over
the turns of CPU time, one thread. The SIMD yardstick is the fastest of six (three algorithms of
`export_simd.c`, 256 and 512 bits wide where the processor has them).
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import platform
import shutil
import subprocess
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import casadi as ca  # noqa: E402 (after the thread counts)
import numpy as np  # noqa: E402

from benchmarks.gp_evaluation import INPUTS, OUTPUTS, by_ad, posterior  # noqa: E402
from benchmarks.variational import derivative, rk4  # noqa: E402
from greybox.model.example import example_vehicle  # noqa: E402
from greybox.model.model import build_model  # noqa: E402
from greybox.model.parameter import nominal_values  # noqa: E402
from greybox.residual.features import feature_layout  # noqa: E402
from greybox.residual.hybrid import HybridModel  # noqa: E402
from greybox.symbolic import Layout  # noqa: E402
from mpc_export import c_kernels_common as common  # noqa: E402
from mpc_export.c_code import FAST_FLAGS, write_c  # noqa: E402
from mpc_export.c_kernels import GPKernel, merged_factor  # noqa: E402

HERE = Path(__file__).resolve().parent
ALL = ("mean", "variance", "mean_jacobian", "variance_jacobian")
TURNS = 15
TIMER = """
#include <time.h>
typedef int (*casadi_function)(const double**, double**, long long*, double*, int);
typedef int (*simd_function)(const void*, const double*, double*, double*, double*, double*);
static double now(void) {
  struct timespec t;
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &t);
  return t.tv_sec + 1e-9*t.tv_nsec;
}
double time_casadi(casadi_function f, const double** arg, double** res, long long* iw, double* w, int n) {
  const double start = now();
  int i;
  for (i = 0; i < n; ++i) f(arg, res, iw, w, 0);
  return (now() - start)/n;
}
double time_simd(simd_function f, const void* data, const double* x, double* m, double* j, double* v, double* vj, int n) {
  const double start = now();
  int i;
  for (i = 0; i < n; ++i) f(data, x, m, j, v, vj);
  return (now() - start)/n;
}
"""
POINTER = ctypes.POINTER(ctypes.c_double)


def shared_library(folder: Path, name: str, text: str | Path, *flags: str) -> Any:
    source = folder / f"{name}.c"
    if isinstance(text, Path):
        source = text
    else:
        source.write_text(text)
    out = folder / f"{name}.so"
    subprocess.run(
        ["gcc", *flags, "-w", "-fPIC", "-shared", "-o", str(out), str(source), "-lm"], check=True
    )
    return ctypes.CDLL(str(out))


class Timer:
    """Calls candidates in turn; a candidate is a function of the number of calls that returns
    seconds per call."""

    def __init__(self, folder: Path) -> None:
        self.driver = shared_library(folder, "timer", TIMER, "-O2", "-D_GNU_SOURCE")
        for name in ("time_casadi", "time_simd"):
            getattr(self.driver, name).restype = ctypes.c_double
        self.candidates: dict[str, tuple[Callable[[int], float], int]] = {}
        self.keep: list[Any] = []

    def add_c(
        self,
        name: str,
        function: Any,
        library: Any,
        symbol: str,
        arguments: list[np.ndarray],
        calls: int,
    ) -> None:
        """A generated function with the sizes of the CasADi function that it came from."""
        sent = [np.asfortranarray(a, dtype=float).ravel(order="F") for a in arguments]
        results = [np.zeros(max(1, function.nnz_out(i))) for i in range(function.n_out())]
        arg = (POINTER * (function.sz_arg() + 8))(*(a.ctypes.data_as(POINTER) for a in sent))
        res = (POINTER * (function.sz_res() + 8))(*(r.ctypes.data_as(POINTER) for r in results))
        iw, w = (ctypes.c_longlong * (function.sz_iw() + 8))(), np.zeros(function.sz_w() + 8)
        code = getattr(library, symbol)
        self.keep += [sent, results, library]
        code(arg, res, iw, w.ctypes.data_as(POINTER), 0)
        for got, want in zip(results, function.call(arguments)):
            if want.nnz() == 0:
                continue
            error = np.abs(got - np.asarray(ca.densify(want)).ravel(order="F")).max()
            assert error < 1e-9 * max(1.0, np.abs(np.asarray(want)).max()), (name, error)
        self.candidates[name] = (
            lambda n: self.driver.time_casadi(code, arg, res, iw, w.ctypes.data_as(POINTER), n),
            calls,
        )

    def add_vm(self, name: str, function: Any, z: np.ndarray, calls: int) -> None:
        buffer, run = function.buffer()
        results = [np.zeros(function.nnz_out(i)) for i in range(function.n_out())]
        buffer.set_arg(0, memoryview(z))
        for i, r in enumerate(results):
            buffer.set_res(i, memoryview(r))
        self.keep += [buffer, z, results]
        self.add_python(name, run, calls)

    def add_python(self, name: str, run: Callable[[], Any], calls: int) -> None:
        def timed(n: int) -> float:
            start = time.process_time()
            for _ in range(n):
                run()
            return (time.process_time() - start) / n

        self.candidates[name] = (timed, calls)

    def run(self) -> dict[str, float]:
        """Median microseconds per call."""
        seconds: dict[str, list[float]] = {name: [] for name in self.candidates}
        for run, calls in self.candidates.values():
            run(max(1, calls // 5))
        for _ in range(TURNS):
            for name, (run, calls) in self.candidates.items():
                seconds[name].append(run(calls))
        return {name: round(1e6 * float(np.median(v)), 3) for name, v in seconds.items()}


def simd(timer: Timer, gp: Any, z: np.ndarray, folder: Path) -> None:
    """The hand-written variants, checked against the posterior."""
    m, p = gp.points, common.padded(gp.points, "double")
    pad = lambda a: np.pad(a, [(0, 0)] * (a.ndim - 1) + [(0, p - m)])  # noqa: E731
    inverse = np.stack([k.lengthscales**-2.0 for k in gp.kernels])
    triangle = lambda f: np.stack([np.pad(a, [(0, p - m), (0, p - m)]).T for a in f])  # noqa: E731 (column-major)
    first, second = triangle(gp.explained), triangle(gp.uncertain)
    merged = [merged_factor(a, b) for a, b in zip(gp.explained, gp.uncertain)]
    rows = np.zeros((p, 16))
    rows[:m, :INPUTS], rows[:m, INPUTS] = gp.support, 1.0
    data = [
        pad(gp.support.T),
        rows,
        pad(-0.5 * inverse @ gp.support.T**2),
        pad(inverse[:, :, None] * gp.support.T[None]),
        inverse,
        pad(gp.weights.T),
        first,
        second,
        np.stack([common.blocks(e, "double") for e in merged]),
        np.stack([np.pad(e.T @ e, [(0, p - m), (0, p - m)]) for e in merged]),
    ]
    data = [np.ascontiguousarray(a, dtype=float) for a in data]
    x = z.ctypes.data_as(POINTER)
    pointers = (POINTER * len(data))(*(a.ctypes.data_as(POINTER) for a in data))
    out = [np.zeros(n) for n in (OUTPUTS, OUTPUTS * INPUTS, OUTPUTS, OUTPUTS * INPUTS)]
    timer.keep += [data, pointers, out]
    flags = ("-std=gnu99", *FAST_FLAGS[1:])
    processor = Path("/proc/cpuinfo").read_text()
    for width in [w for w, need in ((256, "avx2"), (512, "avx512f")) if need in processor]:
        sizes = [
            f"-D{k}={v}"
            for k, v in (("WIDTH", width), ("D", INPUTS), ("O", OUTPUTS), ("P", p), ("M", m))
        ]
        library = shared_library(folder, f"simd{width}", HERE / "export_simd.c", *flags, *sizes)
        for variant in "abc":
            code = getattr(library, f"simd_{variant}")
            addresses = [o.ctypes.data_as(POINTER) for o in out]
            code(pointers, x, *addresses)
            shapes = ((OUTPUTS,), (OUTPUTS, INPUTS), (OUTPUTS,), (OUTPUTS, INPUTS))
            for got, name, shape in zip(
                out, ("mean", "mean_jacobian", "variance", "variance_jacobian"), shapes
            ):
                want = np.asarray(ca.DM(gp.expressions(z, (name,))[name])).reshape(shape)
                assert np.abs(got.reshape(shape) - want).max() < 1e-8 * np.abs(want).max(), (
                    variant,
                    name,
                )
            for what, last in (("jac", [None, None]), ("all", addresses[2:])):
                timer.candidates[f"simd {variant} {width} {what}"] = (
                    lambda n, code=code, last=last, a=addresses: timer.driver.time_simd(
                        code, pointers, x, *a[:2], *last, n
                    ),
                    2000,
                )


def gpytorch_functions(gp: Any, z: np.ndarray) -> dict[str, Callable[[], Any]]:
    """Six independent exact processes on the support points, as a batch; autograd for the
    Jacobians."""
    import gpytorch
    import torch

    torch.set_num_threads(1)
    x = torch.tensor(gp.support, dtype=torch.float64).expand(OUTPUTS, -1, -1)
    y = torch.tensor(np.sin(gp.support[:, :OUTPUTS].T), dtype=torch.float64)
    batch = torch.Size([OUTPUTS])

    class Model(gpytorch.models.ExactGP):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__(x, y, gpytorch.likelihoods.GaussianLikelihood(batch_shape=batch))
            self.mean_module = gpytorch.means.ZeroMean(batch_shape=batch)
            self.covar_module = gpytorch.kernels.ScaleKernel(
                gpytorch.kernels.RBFKernel(ard_num_dims=INPUTS, batch_shape=batch),
                batch_shape=batch,
            )

        def forward(self, at: Any) -> Any:
            return gpytorch.distributions.MultivariateNormal(
                self.mean_module(at), self.covar_module(at)
            )

    model = Model().double()
    model.eval()
    point = torch.tensor(z, dtype=torch.float64)

    def both(v: Any) -> Any:
        with gpytorch.settings.fast_pred_var():
            found = model(v.expand(OUTPUTS, 1, -1))
            return found.mean.ravel(), found.variance.ravel()

    slope = torch.autograd.functional.jacobian
    return {
        "gpytorch jac": lambda: (both(point)[0], slope(lambda v: both(v)[0], point)),
        "gpytorch all": lambda: (both(point), slope(both, point)),
    }


def processes(timer: Timer, gp: Any, z: np.ndarray, folder: Path) -> None:
    """Our kernels, CasADi's forms as C and in the VM, SIMD, GPyTorch."""
    sets = {"jac": ("mean", "mean_jacobian"), "all": ALL}
    kernels = [GPKernel(name=f"gp_{k}", posterior=gp, which=w) for k, w in sets.items()]
    functions = [k.function() for k in kernels]
    ours = write_c(functions, folder, prefix="ours", kernels=kernels)
    better = write_c(functions, folder, prefix="better")
    flags = FAST_FLAGS
    for label, source in (("ours", ours), ("casadi form, our products", better)):
        library = shared_library(folder, source.prefix, source.source, *flags)
        for what, f in zip(sets, functions):
            timer.add_c(f"{label} {what}", f, library, f"{source.prefix}_gp_{what}", [z], 2000)
    for what, which in sets.items():
        form, ad = gp.function(f"form_{what}", which), by_ad(gp, which)
        for label, f in (("casadi form, plain C", form), ("casadi AD, plain C", ad)):
            generator = ca.CodeGenerator(f"{f.name()}.c")
            generator.add(f)
            library = shared_library(folder, f.name() + what, generator.dump(), *flags)
            timer.add_c(f"{label} {what}", f, library, f.name(), [z], 200)
        timer.add_vm(f"casadi form, VM {what}", form, z, 200)
        timer.add_vm(f"casadi AD, VM {what}", ad, z, 30)
    simd(timer, gp, z, folder)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name, run in gpytorch_functions(gp, z).items():
            run()
            timer.add_python(name, run, 4)


def integrators(timer: Timer, gp: Any, folder: Path) -> dict[str, int]:
    """RK4 with Jacobians of a physics model with motor lag and drags, without and with the process
    in every stage."""
    columns = [
        "p",
        "q",
        "r",
        "ax",
        "ay",
        "az",
        "qw",
        "qx",
        "qy",
        "qz",
        "x",
        "y",
        "z",
        "vx",
        "vy",
        "vz",
    ]
    physics = build_model(
        example_vehicle(), columns, ["motor_lag", "rotor_drag", "rotational_damping"]
    )
    names = [*(f"body_velocity.{a}" for a in "xyz"), "p", "q", "r", "nu1", "nu2", "nu3", "nu4"]
    from dataclasses import replace

    outputs = Layout([physics.noises.signals[i] for i in range(OUTPUTS)])
    learned = replace(gp, inputs=feature_layout(physics, names), outputs=outputs)
    hybrid = HybridModel(inner=physics, posterior=learned)
    kernel = GPKernel(name="gp_mean_jac", posterior=learned, which=("mean", "mean_jacobian"))
    steps = [
        rk4(derivative(physics, name="slope_physics"), 0.05, name="physics"),
        rk4(
            derivative(hybrid, name="slope_hybrid", learned=kernel.function()), 0.05, name="hybrid"
        ),
    ]
    source = write_c(steps, folder, prefix="step", kernels=[kernel])
    library = shared_library(folder, "step", source.source, *FAST_FLAGS)
    values = nominal_values(physics.parameters)
    p = np.array([values[q.name] for q in physics.parameters])
    rng = np.random.default_rng(2)
    x = np.asarray(physics.reference({})) + 0.1 * rng.standard_normal(len(physics.states))
    u = np.full(len(physics.inputs), 0.6)
    for f in steps:
        timer.add_c(f"rk4 {f.name()}", f, library, f"step_{f.name()}", [x, u, p], 500)
    mx, mu = ca.MX.sym("x", x.size), ca.MX.sym("u", u.size)
    after = mx
    k1 = hybrid.f(0, after, mu, p)
    k2 = hybrid.f(0, after + 0.025 * k1, mu, p)
    k3 = hybrid.f(0, after + 0.025 * k2, mu, p)
    k4 = hybrid.f(0, after + 0.05 * k3, mu, p)
    after = after + 0.05 / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    ad = ca.Function("rk4_ad", [mx, mu], [after, ca.jacobian(after, ca.vertcat(mx, mu))])
    buffer, run = ad.buffer()
    out = [np.zeros(ad.nnz_out(i)) for i in range(2)]
    for i, a in enumerate((x, u)):
        buffer.set_arg(i, memoryview(a))
    for i, r in enumerate(out):
        buffer.set_res(i, memoryview(r))
    timer.keep += [buffer, out, x, u]
    timer.add_python("rk4 hybrid, casadi AD in the VM", run, 5)
    return {"states": x.size, "inputs": u.size}


def l4casadi(python: str | None, gp: Any, z: np.ndarray, folder: Path) -> dict[str, Any] | None:
    if not python:
        return None
    inverse = np.stack([k.lengthscales**-2.0 for k in gp.kernels])
    build = folder / "l4casadi"
    build.mkdir()
    mean, slope = np.asarray(gp.mean(z)), np.asarray(gp.mean_jacobian(z))
    np.savez(
        folder / "numbers.npz",
        support=gp.support,
        inverse=inverse,
        weights=gp.weights,
        z=z,
        mean=mean,
        jacobian=slope,
    )
    script = [
        python,
        "-W",
        "ignore",
        str(HERE / "export_l4casadi.py"),
        str(folder / "numbers.npz"),
        str(build),
    ]
    done = subprocess.run(script, capture_output=True, text=True, check=True)
    found: dict[str, Any] = json.loads(done.stdout.strip().splitlines()[-1])
    return found


def ratios(us: dict[str, float], other: dict[str, Any] | None) -> dict[str, tuple[float, str]]:
    """Name -> (measured ratio, target)."""
    fastest = {
        w: min(v for k, v in us.items() if k.startswith("simd") and k.endswith(w))
        for w in ("jac", "all")
    }
    linear = 20 * us["rk4 hybrid"] / (80 * us["ours jac"] + 20 * us["rk4 physics"])
    out = {
        "mean + Jacobian over the fastest SIMD": (us["ours jac"] / fastest["jac"], "<= 2"),
        "all over the fastest SIMD": (us["ours all"] / fastest["all"], "<= 1.5"),
        "CasADi's AD as C over ours, all": (us["casadi AD, plain C all"] / us["ours all"], ">= 40"),
        "CasADi's AD in the VM over ours, all": (us["casadi AD, VM all"] / us["ours all"], ">= 40"),
        "GPyTorch autograd over ours, mean + Jacobian": (
            us["gpytorch jac"] / us["ours jac"],
            ">= 1000",
        ),
        "20 RK4 steps over 80 GP calls + physics": (linear, "<= 1.3"),
    }
    if other:
        out["l4casadi over ours, mean + Jacobian"] = (
            other["mean_jacobian"] / us["ours jac"],
            ">= 50",
        )
        vm = other["mean_jacobian"] / us["casadi form, VM jac"]
        out["l4casadi over ours in the VM, mean + Jacobian"] = (vm, ">= 10")
    return {k: (round(v, 2), t) for k, (v, t) in out.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--l4casadi-python", help="interpreter of an environment that has l4casadi")
    parser.add_argument("--points", type=int, default=100)
    parser.add_argument("--out", type=Path, metavar="F.json", help="default: its file in results")
    options = parser.parse_args()
    if not shutil.which("gcc"):
        raise SystemExit("gcc is needed")
    gp = posterior(options.points, share=False)
    z = np.random.default_rng(1).standard_normal(INPUTS)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        timer = Timer(folder)
        processes(timer, gp, z, folder)
        sizes = integrators(timer, gp, folder)
        us = timer.run()
        other = l4casadi(options.l4casadi_python, gp, z, folder)
    version = subprocess.run(
        ["gcc", "--version"], capture_output=True, text=True, check=True
    ).stdout.splitlines()[0]
    found = ratios(us, other)
    text = {
        "question": __doc__.splitlines()[0],
        "unit": "us of CPU time, median",
        "machine": platform.machine(),
        "compiler": version,
        "flags": " ".join(FAST_FLAGS),
        "points": options.points,
        "model": sizes,
        "microseconds": us,
        "l4casadi": other,
        "ratios": {k: {"ratio": v, "target": t} for k, (v, t) in found.items()},
    }
    print(f"{version}; {' '.join(FAST_FLAGS)}")
    for k, v in us.items():
        print(f"{k:45s} {v:10.2f} us")
    if other:
        print(f"{'l4casadi jac (VM, float32)':45s} {other['mean_jacobian']:10.2f} us")
    for k, (v, t) in found.items():
        print(f"{k:50s} {v:8.2f}  target {t}")
    name = "export_speed.json" if options.points == 100 else f"export_speed_{options.points}.json"
    (options.out or HERE / "results" / name).write_text(json.dumps(text, indent=1) + "\n")


if __name__ == "__main__":
    main()
