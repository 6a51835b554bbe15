"""Generated C computes what CasADi computes, compiles strictly, keeps no state, and in float holds
no double arithmetic."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from greybox.errors import ModelError
from mpc_export.c_code import STRICT_FLAGS, CSource, single_precision, write_c

COMPILERS = [c for c in ("gcc", "clang") if shutil.which(c)]
pytestmark = pytest.mark.skipif(not COMPILERS, reason="C compiler is not installed")


def functions() -> list[Any]:
    """Dense and sparse products of both directions, scalar and vector calls, a nested function,
    constants of all sizes."""
    rng = np.random.default_rng(0)
    a, b = rng.standard_normal((23, 11)), rng.standard_normal((23, 3))
    sparse = ca.sparsify(ca.DM(np.tril(rng.standard_normal((11, 11)))))
    gaps = ca.DM(rng.standard_normal((11, 11)) * (rng.random((11, 11)) < 0.4))
    gaps = ca.sparsify(gaps)
    s = ca.SX.sym("s", 11)
    inner = ca.Function(
        "inner",
        [s],
        [
            ca.vertcat(
                ca.atan2(s[0], s[1] + 1e-300),
                ca.fmax(s[3:], 0.5),
                ca.sqrt(s[3] ** 2 + 1),
                ca.floor(s[4]),
            )
        ],
        {"never_inline": True},
    )
    x, y = ca.MX.sym("x", 11), ca.MX.sym("y", 23, 3)
    first = ca.Function(
        "first",
        [x, y],
        [
            ca.DM(a) @ inner(x) + ca.exp(-ca.sumsqr(x)),
            y.T @ (ca.DM(a) @ x),
            sparse @ x,
            sparse.T @ x + gaps.T @ x,
            gaps @ x,
        ],
        ["x", "y"],
        ["far", "near", "lower", "turned", "gaps"],
    )
    second = ca.Function(
        "first_n", [x], [ca.tanh(x) * ca.DM(b[:11, 0]), ca.DM(a).T @ (ca.DM(a) @ ca.cos(x))]
    )
    return [first, second]


@pytest.fixture(scope="module")
def double(tmp_path_factory: pytest.TempPathFactory) -> CSource:
    return write_c(functions(), tmp_path_factory.mktemp("c"), prefix="demo")


@pytest.fixture(scope="module")
def single(tmp_path_factory: pytest.TempPathFactory) -> CSource:
    return write_c(functions(), tmp_path_factory.mktemp("c"), prefix="demo", real="float")


def library(source: CSource, *flags: str, cc: str = COMPILERS[0] if COMPILERS else "cc") -> Path:
    out = source.source.with_suffix(".so")
    command = [
        cc,
        *(flags or ("-std=c99", "-O2")),
        "-fPIC",
        "-shared",
        "-o",
        str(out),
        str(source.source),
        "-lm",
    ]
    subprocess.run(command, check=True, capture_output=True)
    return out


def test_c_equals_casadi(double: CSource) -> None:
    built = library(double)
    rng = np.random.default_rng(1)
    for f in functions():
        c = ca.external(f"demo_{f.name()}", str(built))
        for scale in (0.1, 3.0):
            args = [scale * rng.standard_normal(f.size_in(i)) for i in range(f.n_in())]
            for got, want in zip(c.call(args), f.call(args)):
                assert np.abs(np.asarray(got - want)).max() <= 1e-12 * max(
                    1.0, np.abs(np.asarray(want)).max()
                )


@pytest.mark.parametrize("cc", COMPILERS)
@pytest.mark.parametrize("kind", ["double", "single"])
@pytest.mark.parametrize("level", ["-O0", "-O3"])
def test_source_compiles_strictly(
    cc: str, kind: str, level: str, request: pytest.FixtureRequest
) -> None:
    source: CSource = request.getfixturevalue(kind)
    done = subprocess.run(
        [cc, *STRICT_FLAGS, level, "-c", str(source.source), "-o", "/dev/null"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.skipif(not shutil.which("g++"), reason="C++ compiler is not installed")
def test_the_header_is_taken_by_cpp(double: CSource) -> None:
    user = double.source.with_name("user.cpp")
    user.write_text(
        f'#include "{double.header.name}"\n'
        "int main() { return demo_first(nullptr, nullptr, nullptr, nullptr, 0) + DEMO_FIRST_SZ_W; "
        "}\n"
    )
    subprocess.run(["g++", "-Wall", "-Werror", "-c", str(user), "-o", "/dev/null"], check=True)


def symbols(path: Path) -> list[tuple[str, str]]:
    text = subprocess.run(["nm", str(path)], capture_output=True, text=True, check=True).stdout
    return [
        (m[1], m[2]) for m in re.finditer(r"^[0-9a-f ]{16,17} ?(\w) (\S+)$", text, re.MULTILINE)
    ]


def test_nothing_that_changes_is_stored_and_nothing_but_libm_is_called(
    double: CSource, tmp_path: Path
) -> None:
    out = tmp_path / "x.o"
    subprocess.run(["gcc", "-std=c99", "-O0", "-c", str(double.source), "-o", str(out)], check=True)
    found = symbols(out)
    assert found
    assert not [n for kind, n in found if kind in "bBdDcC"]
    called = {n for kind, n in found if kind == "U"}
    assert called <= {"atan2", "exp", "fmax", "sqrt", "floor", "tanh", "cos", "memset", "memcpy"}
    exported = {n for kind, n in found if kind == "T"}
    assert {"demo_first", "demo_first_n"} <= exported
    assert all(n.startswith("demo") for n in exported)


def test_float_objects_hold_no_double_arithmetic(single: CSource, tmp_path: Path) -> None:
    out = tmp_path / "x.o"
    subprocess.run(["gcc", "-std=c99", "-O1", "-c", str(single.source), "-o", str(out)], check=True)
    called = {n for kind, n in symbols(out) if kind == "U"}
    assert called <= {
        "atan2f",
        "expf",
        "fmaxf",
        "sqrtf",
        "floorf",
        "tanhf",
        "cosf",
        "memset",
        "memcpy",
    }
    code = subprocess.run(
        ["objdump", "-d", str(out)], capture_output=True, text=True, check=True
    ).stdout
    if (
        "xmm" in code
    ):  # x86: conversions and arithmetic of scalar and packed doubles end in sd and pd
        assert not re.search(r"\b(cvt\w*[sp]d\w*|(?:add|mul|sub|div|sqrt)[sp]d)\b", code)


def test_float_agrees_to_its_precision(single: CSource) -> None:
    import ctypes

    built = ctypes.CDLL(str(library(single)))
    f, described = functions()[0], single.functions[0]
    assert described.sz_arg >= f.n_in()
    rng = np.random.default_rng(2)
    args = [rng.standard_normal(f.size_in(i)) for i in range(f.n_in())]
    sent = [np.asfortranarray(a).ravel(order="F").astype(np.float32) for a in args]
    got = [np.zeros(p.nnz, dtype=np.float32) for p in described.outputs]
    pointer = ctypes.POINTER(ctypes.c_float)
    arg = (pointer * described.sz_arg)(*(a.ctypes.data_as(pointer) for a in sent))
    res = (pointer * described.sz_res)(*(r.ctypes.data_as(pointer) for r in got))
    w, iw = (ctypes.c_float * max(described.sz_w, 1))(), (ctypes.c_int * max(described.sz_iw, 1))()
    assert built.demo_first(arg, res, iw, w, 0) == 0
    for have, want in zip(got, f.call(args)):
        expected = np.asarray(want).ravel(order="F")
        assert np.abs(have - expected).max() <= 1e-5 * np.abs(expected).max()


def test_literals_and_calls_become_float_ones() -> None:
    text = (
        "a = 2.*b + 1.5e-3 - exp(x[10]) * casadi_exp(3) + 1e-300 + 1e308; /* 2.5 exp( "
        "*/\n#define P 2.5\nq = y1e5;"
    )
    assert single_precision(text) == (
        "a = 2.f*b + 1.5e-3f - expf(x[10]) * casadi_exp(3) + 0.f + INFINITY; /* 2.5 exp( "
        "*/\n#define P 2.5\nq = y1e5;"
    )


class Twice:
    """A kernel that stands for `inner` and is visibly something else."""

    name = "inner"

    def c_source(self, symbol: str, real: str) -> tuple[dict[str, str], str]:
        return {"two": "static const casadi_real two = 2.0;\n"}, (
            f"static int {symbol}(const casadi_real** arg, casadi_real** res, casadi_int* iw, "
            f"casadi_real* w, int mem) {{\n"
            "  int i;\n  if (res[0]) for (i = 0; i < 11; ++i) res[0][i] = two*arg[0][i];\n  return "
            "0;\n}\n"
        )


def test_a_kernel_takes_the_place_of_its_function_alone(tmp_path: Path) -> None:
    source = write_c(functions(), tmp_path, prefix="demo", kernels=[Twice()])
    assert source.kernels == ("inner",)
    subprocess.run(["gcc", *STRICT_FLAGS, "-c", str(source.source), "-o", "/dev/null"], check=True)
    built = library(source)
    x, y = np.arange(11.0), np.zeros((23, 3))
    a = np.random.default_rng(0).standard_normal((23, 11))
    far = np.asarray(ca.external("demo_first", str(built))(x, y)[0]).ravel()
    np.testing.assert_allclose(far, a @ (2 * x) + np.exp(-(x @ x)), rtol=1e-12)


def test_what_cannot_be_written_is_refused(tmp_path: Path) -> None:
    f = functions()[1]
    with pytest.raises(ModelError, match="identifier"):
        write_c([f], tmp_path, prefix="2x")
    with pytest.raises(ModelError, match="twice"):
        write_c([f, f], tmp_path, prefix="x")
    x = ca.MX.sym("x")
    solver = ca.qpsol(
        "solver", "qrqp", {"x": x, "f": (x - 1) ** 2}, {"print_iter": False, "print_header": False}
    )
    with pytest.raises(ModelError, match="stdio"):
        write_c([ca.Function("f", [x], [solver(lbx=0, ubx=x)["x"]])], tmp_path, prefix="x")
