"""Every line of C that greybox writes into an export itself compiles without a warning under gcc
and clang, and as C++. So do CasADi's own generated functions."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

import mpc_export
from mpc_export.c_code import RESTRICT, single_precision, write_c
from mpc_export.c_kernels import kernels_of
from mpc_export.c_kernels_products import PRODUCTS
from mpc_export.c_model import CModel, identifiers
from mpc_export.c_text import compared
from mpc_export.functions import model_functions
from mpc_export.golden import golden_vectors
from tests.mpc_export import cases

WARNINGS = ("-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror")
C = [(cc, "-std=c99") for cc in ("gcc", "clang")]
CPP = [(cc, "-x", "c++", "-std=c++17") for cc in ("g++", "clang++")]


@pytest.fixture(scope="module")
def functions():
    return model_functions(cases.hybrid(), with_=("filter",))


def complaints(source: Path, compiler: tuple[str, ...], *flags: str) -> str:
    if shutil.which(compiler[0]) is None:
        pytest.skip(f"{compiler[0]} is not installed")
    done = subprocess.run(
        [*compiler, *flags, "-fsyntax-only", str(source)],
        capture_output=True,
        text=True,
        check=False,
    )
    return done.stderr[:3000] if done.returncode or done.stderr else ""


@pytest.mark.parametrize("compiler", C + CPP, ids=lambda c: c[0])
@pytest.mark.parametrize("real", ["double", "float"])
def test_kernels_and_products(functions, tmp_path, real, compiler):
    integer = "long long int" if real == "double" else "int"
    parts = [
        RESTRICT,
        "#include <math.h>",
        f"#define casadi_real {real}",
        f"#define casadi_int {integer}",
    ]
    shared: dict[str, str] = {}
    bodies = []
    for k, kernel in enumerate(kernels_of(functions)):
        more, body = kernel.c_source(f"kernel_{k}", real)
        shared |= more
        bodies.append(body)
    text = "\n".join([*PRODUCTS.values(), *shared.values(), *bodies])
    source = tmp_path / "own.c"
    source.write_text(
        "\n".join([*parts, text if real == "double" else single_precision(text)]) + "\n"
    )
    assert bodies
    assert complaints(source, compiler, *WARNINGS, "-Wno-unused-function") == ""


@pytest.mark.parametrize("compiler", C + CPP, ids=lambda c: c[0])
def test_wrapper_and_self_test(functions, tmp_path, compiler):
    golden = golden_vectors(functions, 2)
    made = write_c(
        list(functions.functions.values()), tmp_path, prefix="quad", kernels=kernels_of(functions)
    )
    CModel(functions, made, "0", golden).write(tmp_path)
    for name in ("quad_model.c", "quad_selftest.c"):
        assert complaints(tmp_path / name, compiler, *WARNINGS) == ""


@pytest.mark.parametrize("compiler", C + CPP, ids=lambda c: c[0])
def test_names_that_differ_in_letters_alone(tmp_path, compiler):
    own = model_functions(cases.own(), with_=("covariance",))
    made = write_c(list(own.functions.values()), tmp_path, prefix="cart", kernels=kernels_of(own))
    CModel(own, made, "0", golden_vectors(own, 2)).write(tmp_path)
    assert complaints(tmp_path / "cart_model.c", compiler, *WARNINGS) == ""
    header = (tmp_path / "cart_model.h").read_text()
    assert {"CART_THETA_M 0", "CART_THETA_m 1", "CART_X_V 0", "CART_X_v 1", "CART_Y_V 0"} <= set(
        re.findall(r"#define (\w+ \d)\b", header)
    )


@pytest.mark.parametrize(
    "names",
    [("M", "m"), ("a.b", "a_b", "A_B"), ("τ", "θ", "0"), ("a", "A", "a_0", "A_0", "a 0", "A 0")],
)
def test_every_name_has_a_macro_of_its_own(names):
    macros = identifiers(names)
    assert len({*macros}) == len(names)
    assert all(re.fullmatch(r"\w+", m, re.ASCII) for m in macros)
    assert identifiers(("p", "u1[t-1]")) == ["P", "U1_T_1"]


@pytest.mark.slow
@pytest.mark.parametrize("compiler", C + CPP, ids=lambda c: c[0])
def test_the_whole_export_is_c_and_cpp(functions, tmp_path, compiler):
    made = write_c(
        list(functions.functions.values()), tmp_path, prefix="quad", kernels=kernels_of(functions)
    )
    assert complaints(made.source, compiler, *WARNINGS) == ""


def test_no_number_of_casadi_is_taken_as_a_truth() -> None:
    text = "a47=(a50?a47:0);\n  a50=(!a50);\n  w3 = (! w3 );\n  (*rr++)  = ((*cr++)?w4:0);\n a=(a1&&w2);"
    assert compared(text) == (
        "a47=((a50!=0)?a47:0);\n  a50=(a50==0);\n  w3 = (w3==0);\n  (*rr++)  = (((*cr++)!=0)?w4:0);\n "
        "a=((a1!=0)&&(w2!=0));"
    )


def test_no_function_of_ours_has_a_name_of_the_c_library() -> None:
    """Whatever dialect a user compiles in: GNU's declares more than ISO C (`finite`)."""
    if shutil.which("gcc") is None:
        pytest.skip("gcc is not installed")
    headers = "".join(f"#include <{h}.h>\n" for h in ("math", "stdlib", "string", "stdint"))
    told = subprocess.run(
        ["gcc", "-std=gnu17", "-D_GNU_SOURCE", "-E", "-P", "-"],
        input=headers,
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    library = set(re.findall(r"\b(\w+) ?\(", told))
    assert {"finite", "sqrt", "memcpy"} <= library
    sources = list(Path(mpc_export.__file__).parent.rglob("*.[ch]"))
    assert len(sources) > 10
    for source in sources:
        own = re.findall(r"^(?:static |inline )+[\w* ]*?\b(\w+)\(", source.read_text(), re.M)
        assert not library & set(own), source.name
