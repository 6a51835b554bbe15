"""The Gaussian process in our own C gives what its CasADi expressions give: every kernel, near the
data and far away."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from greybox.errors import ModelError, UnknownNameError
from greybox.residual import sparse
from greybox.residual.kernels import Kernel
from greybox.residual.posterior import Domain, GPPosterior
from greybox.symbolic import Layout, Signal
from mpc_export.c_code import FAST_FLAGS, STRICT_FLAGS, CSource, write_c
from mpc_export.c_kernels import GPKernel, merged_factor

ALL = ("mean", "variance", "mean_jacobian", "variance_jacobian")
COMPILERS = [c for c in ("gcc", "clang") if shutil.which(c)]
pytestmark = pytest.mark.skipif(not COMPILERS, reason="C compiler is not installed")


def posterior(
    names: tuple[str, ...],
    *,
    points: int = 21,
    method: str = "sgpr",
    silent: tuple[int, ...] = (),
    noise: float = 0.01,
    inputs: int = 4,
) -> GPPosterior:
    """One output per kernel name ("same" shares the one before); inputs and outputs scaled and
    shifted."""
    n_in, rng = inputs, np.random.default_rng(7)
    x = rng.standard_normal((200, n_in))
    kernels: list[Kernel] = []
    for name in names:
        if name == "same":
            kernels.append(kernels[-1])
            continue
        linear = name.startswith("linear+")
        kernels.append(
            Kernel(
                family=name.removeprefix("linear+"),
                lengthscales=rng.uniform(1.0, 3.0, n_in),
                variance=float(rng.uniform(0.5, 2.0)),
                slopes=rng.uniform(0.1, 0.5, n_in) if linear else None,
                reach=np.full(n_in, 4.0) if linear else None,
            )
        )
    y = [
        np.sin(x[:, j % n_in]) + 0.5 * x[:, 0] + 0.1 * rng.standard_normal(200)
        for j in range(len(names))
    ]
    if method == "exact":
        numbers = [sparse.exact(k, x[:points].T, v[:points], noise) for k, v in zip(kernels, y)]
    else:
        numbers = [sparse.collapsed(k, x[:points].T, x.T, v, noise) for k, v in zip(kernels, y)]
    weights = np.stack([n.weights for n in numbers], axis=1)
    weights[:, list(silent)] = 0.0
    grow = 3.0 if method == "svgp" else 1.0  # an SVGP may be less sure than its prior
    n_out = len(names)
    return GPPosterior(
        inputs=Layout([Signal(name=f"z{i}", unit="-") for i in range(n_in)]),
        outputs=Layout([Signal(name=f"y{i}", unit="N") for i in range(n_out)]),
        method=method,
        kernels=tuple(kernels),
        input_mean=rng.standard_normal(n_in),
        input_scale=rng.uniform(0.5, 2.0, n_in),
        output_mean=rng.standard_normal(n_out),
        output_scale=rng.uniform(0.5, 2.0, n_out),
        support=x[:points],
        weights=weights,
        explained=np.stack([n.explained for n in numbers]),
        uncertain=grow * np.stack([n.uncertain for n in numbers]),
        noise=np.full(n_out, 0.02),
        group_noise={"flight": np.full(n_out, 0.05)},
        variance_factor=tuple(rng.uniform(1.0, 1.5, n_out)),
        domain=Domain(lower=x.min(0), upper=x.max(0)),
    )


def compiled(source: CSource, *flags: str) -> Path:
    out = source.source.with_suffix(".so")
    command = [
        "gcc",
        *STRICT_FLAGS,
        *(flags or ("-O1", *FAST_FLAGS[2:])),
        "-fPIC",
        "-shared",
        "-o",
        str(out),
        str(source.source),
        "-lm",
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return out


def inputs(gp: GPPosterior, n: int, seed: int = 0) -> list[Any]:
    """Inside the training domain, at its edge, at support points, and far outside."""
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((n, len(gp.inputs))) * rng.choice([0.3, 1.0, 3.0, 10.0, 1e3], (n, 1))
    x[: min(n, 3)] = gp.support[: min(n, 3)] * (1.0 + 1e-3)
    return list(x * gp.input_scale + gp.input_mean)


def largest_difference(kernel: GPKernel, library: Path, points: list[Any]) -> float:
    """Over all results, relative to the largest value of each."""
    c, f = ca.external(f"m_{kernel.name}", str(library)), kernel.function()
    pairs = [
        (
            np.asarray(ca.vertcat(*map(ca.vec, c.call([z])))),
            np.asarray(ca.vertcat(*map(ca.vec, f.call([z])))),
        )
        for z in points
    ]
    got, want = (np.hstack(v) for v in zip(*pairs))
    return float((np.abs(got - want).max(1) / np.maximum(np.abs(want).max(1), 1e-12)).max())


CASES = {
    "se": posterior(("se", "se", "same")),
    "matern": posterior(("matern32", "matern52")),
    "linear": posterior(("linear+se", "linear+matern32", "linear+matern52")),
    "exact": posterior(("se", "linear+se"), method="exact"),
    "svgp": posterior(("se", "matern32"), method="svgp"),
    "silent": posterior(("se", "linear+se", "same"), silent=(1,)),
    "all silent": posterior(("se", "linear+se"), silent=(0, 1)),
    "one point": posterior(("se",), points=1),
}


@pytest.mark.parametrize("case", CASES)
def test_every_kind_equals_its_expressions(case: str, tmp_path: Path) -> None:
    gp = CASES[case]
    kernels = [
        GPKernel(name="gp_mean", posterior=gp, which=("mean",)),
        GPKernel(name="gp_jac", posterior=gp, which=("mean", "mean_jacobian")),
        GPKernel(name="gp_all", posterior=gp, which=ALL),
        GPKernel(
            name="gp_far",
            posterior=gp,
            which=("distance", "variance_jacobian", "variance"),
            noise=True,
        ),
        GPKernel(name="gp_new", posterior=gp, which=("variance",), noise="flight"),
    ]
    source = write_c([k.function() for k in kernels], tmp_path, prefix="m", kernels=kernels)
    assert source.kernels == tuple(k.name for k in kernels)
    library = compiled(source)
    for kernel in kernels:
        assert largest_difference(kernel, library, inputs(gp, 60)) < 1e-12


@pytest.mark.parametrize("cc", COMPILERS)
@pytest.mark.parametrize(
    "flags",
    [
        ("-O0",),
        ("-O3", "-U__SSE2__"),
        ("-O2", "-mavx2", "-mfma"),
        ("-fsanitize=undefined,address", "-g"),
    ],
)
def test_every_width_of_vectors_gives_the_same(
    cc: str, flags: tuple[str, ...], tmp_path: Path
) -> None:
    """Compiled strictly by both compilers; run as a program, so that the sanitisers can watch."""
    if "-mavx2" in flags and "avx2" not in Path("/proc/cpuinfo").read_text():
        pytest.skip("this processor has no AVX2")
    gp = CASES["linear"]
    kernel = GPKernel(name="gp_all", posterior=gp, which=ALL)
    source = write_c([kernel.function()], tmp_path, prefix="m", kernels=[kernel])
    if "-fsanitize=undefined,address" in flags and cc == "clang":
        pytest.skip("Debian's clang comes without the sanitisers' libraries")
    f = source.functions[0]
    sizes = [p.nnz for p in f.outputs]
    z = inputs(gp, 5)[4]
    main = tmp_path / "main.c"
    main.write_text(
        '#include <stdio.h>\n#include "m.h"\nint main(void) {\n'
        f"  static const double z[] = {{{', '.join(map(repr, map(float, z)))}}};\n"
        f"  double r[{sum(sizes)}], w[M_GP_ALL_SZ_W + 1];\n  m_int iw[M_GP_ALL_SZ_IW + 1];\n"
        "  const double* arg[M_GP_ALL_SZ_ARG] = {z};\n  double* res[M_GP_ALL_SZ_RES] = {0};\n  int "
        "i;\n"
        + "".join(f"  res[{i}] = r + {sum(sizes[:i])};\n" for i in range(len(sizes)))
        + "  if (m_gp_all(arg, res, iw, w, 0)) return 1;\n"
        f'  for (i = 0; i < {sum(sizes)}; ++i) printf("%.17g\\n", r[i]);\n  return 0;\n}}\n'
    )
    program = tmp_path / "main"
    command = [cc, *STRICT_FLAGS, *flags, "-o", str(program), str(main), str(source.source), "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    done = subprocess.run([str(program)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    got = np.array([float(v) for v in done.stdout.split()])
    want = np.asarray(ca.vertcat(*map(ca.vec, kernel.function().call([z])))).ravel()
    np.testing.assert_allclose(got, want, rtol=1e-11, atol=1e-13)


def test_the_merged_factor_is_the_difference_of_the_two() -> None:
    gp = posterior(("se",), points=40)
    first, second = gp.explained[0], gp.uncertain[0]
    merged = merged_factor(first, second)
    assert merged is not None
    assert np.array_equal(merged, np.tril(merged))
    want = first.T @ first - second.T @ second
    np.testing.assert_allclose(merged.T @ merged, want, atol=1e-9 * np.abs(first.T @ first).max())
    assert (
        merged_factor(first, 3.0 * second) is None
        or np.linalg.norm(3.0 * second @ np.linalg.inv(first), 2) <= 1.0
    )


def test_nearly_singular_covariances_keep_the_variance() -> None:
    """Long length-scales and 60 points: the kernel matrix has condition 1e10 and more."""
    rng = np.random.default_rng(3)
    x = rng.standard_normal((2, 500))
    kernel = Kernel(family="se", lengthscales=np.full(2, 3.0), variance=1.0)
    numbers = sparse.collapsed(kernel, x[:, :60], x, np.sin(x[0]), 1e-3)
    merged = merged_factor(numbers.explained, numbers.uncertain)
    assert merged is not None
    assert np.abs(merged).max() < 0.1 * np.abs(numbers.explained).max()
    for z in rng.standard_normal((50, 2)):
        k = kernel.covariance(x[:, :60], z[:, None]).ravel()
        two = 1.0 - np.sum((numbers.explained @ k) ** 2) + np.sum((numbers.uncertain @ k) ** 2)
        assert abs(1.0 - np.sum((merged @ k) ** 2) - two) < 1e-9


def test_a_gp_inside_another_function_is_replaced(tmp_path: Path) -> None:
    gp = CASES["se"]
    kernel = GPKernel(name="gp_jac", posterior=gp, which=("mean", "mean_jacobian"))
    z = ca.MX.sym("z", 4)
    mean, slope = kernel.function()(ca.sin(z))
    f = ca.Function("outer", [z], [mean.T @ slope])
    source = write_c([f], tmp_path, prefix="m", kernels=[kernel])
    assert source.kernels == ("gp_jac",)
    c = ca.external("m_outer", str(compiled(source)))
    for point in inputs(gp, 20):
        np.testing.assert_allclose(
            np.asarray(c(point)), np.asarray(f(point)), rtol=1e-11, atol=1e-12
        )


def test_weights_and_silent_outputs_can_come_from_the_call(tmp_path: Path) -> None:
    """p holds three other numbers, then the weights column by column; outputs that are off have no
    variance."""
    gp = CASES["silent"]
    kernel = GPKernel(
        name="gp",
        posterior=gp,
        which=("mean", "variance", "mean_jacobian"),
        weights=(1, 3),
        silent=True,
    )
    z, p = ca.MX.sym("z", 4), ca.MX.sym("p", 3 + gp.weights.size)
    f = ca.Function("gp", [z, p], [ca.MX(3, 1), ca.MX(3, 1), ca.MX(3, 4)])
    f = ca.Function(
        "gp", [z, p], [ca.densify(ca.sin(v)) + p[0] for v in (z[:3], z[:3], ca.repmat(z[:3], 1, 4))]
    )
    c = ca.external("m_gp", str(compiled(write_c([f], tmp_path, prefix="m", kernels=[kernel]))))
    weights = 2.0 * gp.weights
    twice = replace(gp, weights=weights)
    for point in inputs(gp, 10):
        mean, variance, slope = c(
            point, np.concatenate([[9.0, 9.0, 9.0], weights.ravel(order="F")])
        )
        np.testing.assert_allclose(
            np.asarray(mean), np.asarray(twice.mean(point)), rtol=1e-11, atol=1e-12
        )
        np.testing.assert_allclose(
            np.asarray(slope), np.asarray(twice.mean_jacobian(point)), rtol=1e-10, atol=1e-12
        )
        want = np.asarray(gp.variance(point)).ravel() * [1.0, 0.0, 1.0]
        np.testing.assert_allclose(np.asarray(variance).ravel(), want, rtol=1e-11, atol=1e-12)


def test_results_that_are_not_wanted_and_nan_are_handled(tmp_path: Path) -> None:
    gp = CASES["se"]
    kernel = GPKernel(name="gp_all", posterior=gp, which=ALL)
    source = write_c([kernel.function()], tmp_path, prefix="m", kernels=[kernel])
    f = source.functions[0]
    run = ctypes.CDLL(str(compiled(source))).m_gp_all
    pointer = ctypes.POINTER(ctypes.c_double)
    z, r = np.full(4, np.nan), np.zeros(3)
    arg = (pointer * f.sz_arg)(z.ctypes.data_as(pointer))
    res = (pointer * f.sz_res)()
    res[1] = r.ctypes.data_as(pointer)
    w = (ctypes.c_double * (f.sz_w + 1))()
    assert run(arg, res, None, w, 0) == 0
    assert np.isnan(r).all()
    arg[0] = pointer()  # null: zeros
    assert run(arg, res, None, w, 0) == 0
    np.testing.assert_allclose(r, np.asarray(gp.variance(np.zeros(4))).ravel(), rtol=1e-11)


def test_float_is_right_to_a_few_of_its_digits(tmp_path: Path) -> None:
    gp = posterior(("se", "linear+se", "matern52"), points=30, noise=0.1)
    kernel = GPKernel(name="gp_all", posterior=gp, which=ALL)
    source = write_c([kernel.function()], tmp_path, prefix="m", kernels=[kernel], real="float")
    subprocess.run(
        ["gcc", *STRICT_FLAGS, "-c", str(source.source), "-o", str(tmp_path / "x.o")], check=True
    )
    names = subprocess.run(
        ["nm", str(tmp_path / "x.o")], capture_output=True, text=True, check=True
    ).stdout
    assert {line.split()[-1] for line in names.splitlines() if " U " in line} <= {
        "sqrtf",
        "memset",
        "memcpy",
    }
    run, f = ctypes.CDLL(str(compiled(source))).m_gp_all, source.functions[0]
    pointer = ctypes.POINTER(ctypes.c_float)
    casadi = kernel.function()
    worst, size = np.zeros(4), np.zeros(4)
    for point in inputs(gp, 100):
        z = point.astype(np.float32)
        out = [np.zeros(p.nnz, dtype=np.float32) for p in f.outputs]
        arg = (pointer * f.sz_arg)(z.ctypes.data_as(pointer))
        res = (pointer * f.sz_res)(*(o.ctypes.data_as(pointer) for o in out))
        assert run(arg, res, None, (ctypes.c_float * (f.sz_w + 1))(), 0) == 0
        for i, (o, v) in enumerate(zip(out, casadi.call([z.astype(float)]))):
            want = np.asarray(v).ravel(order="F")
            worst[i], size[i] = (
                max(worst[i], np.abs(o - want).max()),
                max(size[i], np.abs(want).max()),
            )
    assert (worst <= 1e-4 * size).all(), worst / size


def test_what_a_kernel_cannot_do_is_said() -> None:
    with pytest.raises(UnknownNameError, match="GP quantity"):
        GPKernel(name="gp", posterior=CASES["se"], which=("median",))
    with pytest.raises(ModelError, match="no quantity"):
        GPKernel(name="gp", posterior=CASES["se"], which=())
