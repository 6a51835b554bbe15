"""C of a bundle equals CasADi at 1e-10 of the output's scale (float: 1e-4), inside the domain, at
its edge, far outside."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest

from greybox.model.effects import effect_by_name
from greybox.symbolic import Layout
from mpc_export.bundle import write_bundle
from mpc_export.c_code import write_c
from mpc_export.c_model import abi_number
from mpc_export.golden import golden_vectors
from mpc_export.verify import STRICT
from tests.conformance import specimen
from tests.conformance.remembering import Wake
from tests.mpc_export import cases, compiled
from tests.residual import hybrid_cases

LIMIT = {"double": 1e-10, "float": 1e-4}


@pytest.fixture(scope="module")
def hybrid(tmp_path_factory):
    folder = tmp_path_factory.mktemp("hybrid") / "quad"
    return write_bundle(
        cases.hybrid(), folder, with_=("covariance", "filter", "target"), use_cache=False
    )


@pytest.fixture(scope="module")
def objects(hybrid, tmp_path_factory):
    """The library's two units, compiled strictly and without optimisation."""
    return compiled.compile_objects(hybrid, tmp_path_factory.mktemp("objects"), "gcc", "-O0")


@pytest.fixture(scope="module")
def library(objects, tmp_path_factory):
    return compiled.link(objects, tmp_path_factory.mktemp("lib"))


def points(functions, count, seed=0):
    rng = np.random.default_rng(seed)
    spreads = np.resize([0.3, 1.0, 1.0, 3.0, 30.0], count)
    return [cases.point(functions, rng, float(s)) for s in spreads]


def with_effect(effect):
    model = specimen.model_with(effect)
    rng = np.random.default_rng(1)
    values = specimen.at_random(effect, specimen.crooked(), rng)
    identified = hybrid_cases.craft_model(model).with_values(values)
    inputs = np.array([3.8 if name == "vbat" else 0.5 for name in model.inputs.names])
    return replace(
        identified,
        reference_state=model.reference({"u1": 0.5, "z": 1.0}),
        reference_inputs=inputs,
        covariance_names=(),
        covariance=np.zeros((0, 0)),
    )


SOME = ("battery_sag", "ground_effect")


@pytest.mark.parametrize(
    "effect", [*(effect_by_name(n) for n in SOME), Wake()], ids=lambda e: e.name
)
def test_some_effects_alone_in_double(tmp_path, effect):
    bundle = write_bundle(with_effect(effect), tmp_path / "one", targets=("c",), use_cache=False)
    library = compiled.load(
        bundle, compiled.compile_library(bundle, tmp_path / "lib", "gcc", "-O0")
    )
    gaps = compiled.largest_difference(
        bundle, library, bundle.functions.functions, points(bundle.functions, 60)
    )
    assert max(gaps.values()) < LIMIT["double"], gaps


def test_a_hybrid_in_double(hybrid, library):
    gaps = compiled.largest_difference(
        hybrid,
        compiled.load(hybrid, library),
        hybrid.functions.functions,
        points(hybrid.functions, 300),
    )
    assert len(gaps) == len(hybrid.manifest["functions"])
    assert max(gaps.values()) < LIMIT["double"], gaps


@pytest.mark.parametrize("kind", ["hybrid", "linear"])
def test_single_precision(tmp_path, kind):
    model = {"hybrid": cases.hybrid, "linear": cases.linear}[kind]()
    bundle = write_bundle(
        model, tmp_path / "single", real="float", with_=("filter", "covariance"), use_cache=False
    )
    flags = ("-O0", "-Wdouble-promotion")
    library = compiled.load(
        bundle, compiled.compile_library(bundle, tmp_path / "lib", "gcc", *flags)
    )
    every = {g.name: g for g in golden_vectors(bundle.functions, 12)}
    for entry in bundle.manifest["functions"]:
        golden = every[entry["name"]]
        for row in range(12):
            got = library.call(entry, [v[row].tolist() for v in golden.arguments.values()])
            for port, ours in zip(entry["results"], got, strict=True):
                want = golden.results[port["name"]]
                scale = port["scale"]
                if port["columns"] == 1:  # signals have scales of their own
                    scale = np.maximum(np.abs(want).max(axis=0, initial=0.0), 1e-6 * scale)
                gap = np.abs(np.array(ours) - want[row])
                assert (gap <= LIMIT["float"] * scale).all(), (entry["name"], port["name"])


def test_weights_and_mass_change_at_run_time_in_c_too(tmp_path):
    model = cases.hybrid()
    runtime = ("mass", "gp.weights")
    bundle = write_bundle(
        model, tmp_path / "rt", targets=("c",), runtime_parameters=runtime, use_cache=False
    )
    library = compiled.load(
        bundle, compiled.compile_library(bundle, tmp_path / "lib", "gcc", "-O0")
    )
    rng, some = np.random.default_rng(4), points(bundle.functions, 20)
    for point in some:
        point["p"] = point["p"] * rng.uniform(0.5, 1.5, point["p"].size)
    gaps = compiled.largest_difference(bundle, library, bundle.functions.functions, some)
    assert max(gaps.values()) < LIMIT["double"], gaps


@pytest.mark.slow
@pytest.mark.parametrize("effect", specimen.effects_under_test())
def test_every_effect_alone_over_ten_thousand_points(tmp_path, effect):
    bundle = write_bundle(with_effect(effect), tmp_path / "one", targets=("c",), use_cache=False)
    library = compiled.load(bundle, compiled.compile_library(bundle, tmp_path / "lib"))
    gaps = compiled.largest_difference(
        bundle, library, bundle.functions.functions, points(bundle.functions, 10_000)
    )
    assert max(gaps.values()) < LIMIT["double"], gaps


@pytest.mark.slow
@pytest.mark.parametrize("kernel", ["se", "linear+se", "matern32", "linear+matern52"])
def test_hybrids_over_ten_thousand_points(tmp_path, kernel):
    bundle = write_bundle(
        cases.hybrid(50, kernel),
        tmp_path / "h",
        targets=("c",),
        with_=("covariance", "filter"),
        use_cache=False,
    )
    library = compiled.load(bundle, compiled.compile_library(bundle, tmp_path / "lib"))
    gaps = compiled.largest_difference(
        bundle, library, bundle.functions.functions, points(bundle.functions, 10_000)
    )
    assert max(gaps.values()) < LIMIT["double"], gaps


# ----------------------------------------------------------------------------------- the C itself


@pytest.mark.parametrize("compiler", ["gcc", "clang"])
def test_self_test_and_wrapper_compile_strictly_and_pass(hybrid, objects, tmp_path, compiler):
    if compiler not in compiled.COMPILERS:
        pytest.skip(f"{compiler} is not installed")
    made = (
        objects
        if compiler == "gcc"
        else compiled.compile_objects(hybrid, tmp_path, compiler, "-O0")
    )
    source = hybrid.folder / "c" / f"{hybrid.name}_selftest.c"
    subprocess.run(
        [compiler, *STRICT, "-O0", source, *made, "-o", tmp_path / "selftest", "-lm"], check=True
    )
    done = subprocess.run([tmp_path / "selftest"], capture_output=True, text=True, check=False)
    assert done.returncode == 0 and "passed" in done.stdout, done.stdout


@pytest.mark.slow
def test_no_address_error_and_no_undefined_behaviour(hybrid, tmp_path):
    compiled.needs_compiler()
    flags = ["-O0", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-std=c99"]
    source = [hybrid.folder / "c" / f"{hybrid.name}{s}.c" for s in ("", "_model", "_selftest")]
    done = subprocess.run(
        ["gcc", *flags, *source, "-o", tmp_path / "selftest", "-lm"],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode and "sanitize" in done.stderr:
        pytest.skip("no sanitizers")
    assert done.returncode == 0, done.stderr[:2000]
    done = subprocess.run([tmp_path / "selftest"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, (done.stdout + done.stderr)[-2000:]


def test_the_self_test_finds_a_wrong_number(hybrid, objects, tmp_path):
    folder, name = hybrid.folder / "c", hybrid.name
    text = (folder / f"{name}_selftest.c").read_text()
    place = re.search(r"want_x_next\[\d+\] = \{\n\s+(-?[\d.e+-]+),", text)
    assert place is not None
    wrong = text[: place.start(1)] + repr(float(place[1]) + 1e-6) + text[place.end(1) :]
    (tmp_path / f"{name}_selftest.c").write_text(wrong)
    source = [tmp_path / f"{name}_selftest.c", *objects]
    subprocess.run(
        ["gcc", "-std=c99", "-O0", f"-I{folder}", *source, "-o", tmp_path / "selftest", "-lm"],
        check=True,
    )
    done = subprocess.run([tmp_path / "selftest"], capture_output=True, text=True, check=False)
    assert done.returncode == 1 and "FAILED" in done.stdout


def test_the_library_has_no_writable_data(hybrid, library):
    symbols = subprocess.run(["nm", library], capture_output=True, text=True, check=True).stdout
    own = [line.split() for line in symbols.splitlines()]
    writable = [
        w[-1]
        for w in own
        if len(w) == 3 and w[1] in "bBdD" and not w[-1].startswith(("_", "completed", "__"))
    ]
    assert writable == []
    needed = {w[-1].split("@")[0] for w in own if w[0] == "U"}
    assert not needed & {"malloc", "free", "calloc", "printf", "fprintf", "puts"}


def test_cpp_takes_the_header(hybrid, objects, tmp_path):
    if shutil.which("g++") is None:
        pytest.skip("C++ compiler is not installed")
    folder, name = hybrid.folder / "c", hybrid.name
    done = subprocess.run(
        [
            "g++",
            "-std=c++17",
            "-Wall",
            "-Wextra",
            "-Werror",
            folder / f"{name}_example.cpp",
            *objects,
            "-o",
            tmp_path / "example",
            "-lm",
        ],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[:2000]
    done = subprocess.run([tmp_path / "example"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    assert "after one second" in done.stdout


CODES = """
#include <stdio.h>
#include "NAME_model.h"
int main(void) {
  static NAME_work work;
  double x[UP_N_X], u[UP_N_U], next[UP_N_X];
  int i, k;
  for (k = 0; k < 4; ++k) {
    for (i = 0; i < UP_N_X; ++i) x[i] = NAME_x_reference[i];
    for (i = 0; i < UP_N_U; ++i) u[i] = NAME_u_reference[i];
    if (k == 1) u[UP_U_U2] = 1.5;
    if (k == 2) x[UP_X_ATTITUDE_W] = 0.5;
    if (k == 3) x[UP_X_RATE_X] = 0.0 / u[UP_U_U1] / 0.0;
    printf("%d ", NAME_eval_f_d(x, u, 0, next, &work));
  }
  for (i = 0; i < UP_N_X; ++i) x[i] = NAME_x_reference[i];
  x[UP_X_RATE_X] = 1e300;
  printf("%d ", NAME_eval_f_d(x, u, 0, 0, &work));
  printf("%d\\n", NAME_eval_f_d(x, u, 0, next, &work));
  return NAME_abi() == UP_ABI ? 0 : 1;
}
"""


def test_return_codes_tell_what_is_wrong(hybrid, objects, tmp_path):
    folder, name = hybrid.folder / "c", hybrid.name
    text = CODES.replace("NAME", name).replace("UP_", f"{name.upper()}_")
    (tmp_path / "codes.c").write_text(text)
    source = [tmp_path / "codes.c", *objects]
    command = [
        "gcc",
        "-std=c99",
        "-O0",
        "-w",
        f"-I{folder}",
        *source,
        "-o",
        tmp_path / "codes",
        "-lm",
    ]
    subprocess.run(command, check=True)
    done = subprocess.run([tmp_path / "codes"], capture_output=True, text=True, check=False)
    assert done.returncode == 0
    assert done.stdout.split() == ["0", "1", "1", "2", "0", "3"]
    wrong = subprocess.run(
        [*command, f"-D{name.upper()}_EXPECTED_ABI=1u"], capture_output=True, text=True, check=False
    )
    assert wrong.returncode != 0
    assert "another layout" in wrong.stderr


MISSING = """
#include <stdio.h>
#include "NAME_model.h"
int main(void) {
  static NAME_work work;
  double y[UP_N_Y], there[UP_N_E], next[UP_N_X], e[UP_N_E];
  const double zero = 0;
  int i, k;
  for (k = 0; k < 5; ++k) {
    for (i = 0; i < UP_N_E; ++i) there[i] = 1;
    NAME_eval_h(NAME_x_reference, NAME_u_reference, 0, y, &work);
    next[0] = -77;
    if (k == 1 || k == 2) y[UP_Y_P] = zero / zero;
    if (k < 2) there[UP_E_P] = 0;
    if (k > 2) y[UP_Y_X] = zero / zero;
    if (k == 3) there[UP_E_POSITION_X] = 0;
    printf("%d ", NAME_eval_filter_step(NAME_x_reference, NAME_u_reference, 0, y, there, next, e, 0, &work));
    printf("%d ", next[0] == -77);
  }
  return 0;
}
"""


def test_a_missing_measurement_may_be_nan_and_a_wrong_one_may_not(hybrid, objects, tmp_path):
    text = MISSING.replace("NAME", hybrid.name).replace("UP_", f"{hybrid.name.upper()}_")
    (tmp_path / "missing.c").write_text(text)
    source = [tmp_path / "missing.c", *objects]
    command = [
        "gcc",
        "-std=c99",
        "-O0",
        f"-I{hybrid.folder / 'c'}",
        *source,
        "-o",
        tmp_path / "missing",
        "-lm",
    ]
    subprocess.run(command, check=True)
    done = subprocess.run([tmp_path / "missing"], capture_output=True, text=True, check=False)
    # (code, whether nothing was written); without the world's x no position in body axes counts
    pairs = [("0", "0"), ("0", "0"), ("2", "1"), ("0", "0"), ("2", "1")]
    assert done.returncode == 0
    assert done.stdout.split() == [word for pair in pairs for word in pair]


NO_LENGTH = """
#include <stdio.h>
#include "NAME_model.h"
int main(void) {
  static NAME_work work;
  const double sizes[] = {1, 0.51, 1.99, 0, 0.49, 2.01, 5, 1e-200, 1e200};
  double y[UP_N_Y], there[UP_N_E], next[UP_N_X], without[UP_N_X];
  int i, k, code, same;
  for (i = 0; i < UP_N_E; ++i) there[i] = 1;
  there[UP_E_ATTITUDE_X] = 0;
  NAME_eval_h(NAME_x_reference, NAME_u_reference, 0, y, &work);
  y[UP_Y_X] += 0.1;
  NAME_eval_filter_step(NAME_x_reference, NAME_u_reference, 0, y, there, without, 0, 0, &work);
  for (k = 0; k < 10; ++k) {
    there[UP_E_ATTITUDE_X] = k < 9;  /* the last says itself that it is missing */
    NAME_eval_h(NAME_x_reference, NAME_u_reference, 0, y, &work);
    y[UP_Y_X] += 0.1;
    y[UP_Y_QW] = k < 9 ? sizes[k] * 0.995 : 0;
    y[UP_Y_QX] = k < 9 ? sizes[k] * 0.0998749 : 0;
    y[UP_Y_QY] = y[UP_Y_QZ] = 0;
    code = NAME_eval_filter_step(NAME_x_reference, NAME_u_reference, 0, y, there, next, 0, 0, &work);
    for (same = 1, i = 0; i < UP_N_X; ++i) same = same && next[i] == without[i];
    printf("%d %d ", code, same);
  }
  return 0;
}
"""


def test_a_quaternion_of_no_length_counts_as_missing_and_the_code_says_so(
    hybrid, objects, tmp_path
):
    text = NO_LENGTH.replace("NAME", hybrid.name).replace("UP_", f"{hybrid.name.upper()}_")
    (tmp_path / "length.c").write_text(text)
    program = tmp_path / "length"
    command = ["gcc", "-std=c99", "-O0", f"-I{hybrid.folder / 'c'}", tmp_path / "length.c"]
    subprocess.run([*command, *objects, "-o", program, "-lm"], check=True)
    done = subprocess.run([program], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["0", "0"] * 3 + ["1", "1"] * 6 + ["0", "1"]
    header = (hybrid.folder / "c" / f"{hybrid.name}_model.h").read_text(encoding="utf-8")
    assert "counts as missing" in header


def test_the_layout_number_knows_every_order(hybrid):
    functions = hybrid.functions
    source = write_c(
        list(functions.functions.values())[:2], hybrid.folder.parent / "abi", prefix="abi"
    )
    number = abi_number(functions, source)
    assert abi_number(functions, source) == number
    for name in ("innovations", "features", "learned", "targets"):
        other = replace(functions, **{name: Layout(list(getattr(functions, name))[::-1])})
        assert abi_number(other, source) != number, name
    assert (
        abi_number(replace(functions, covariance_names=functions.covariance_names[::-1]), source)
        != number
    )


@pytest.mark.slow
def test_cmake_builds_tests_and_installs(hybrid, tmp_path):
    if shutil.which("cmake") is None:
        pytest.skip("no cmake")
    build = tmp_path / "build"
    subprocess.run(
        [
            "cmake",
            "-S",
            hybrid.folder / "c",
            "-B",
            build,
            f"-DCMAKE_INSTALL_PREFIX={tmp_path / 'in'}",
        ],
        check=True,
        capture_output=True,
    )
    subprocess.run(["cmake", "--build", build], check=True, capture_output=True)
    subprocess.run(
        ["ctest", "--test-dir", build, "--output-on-failure"], check=True, capture_output=True
    )
    subprocess.run(["cmake", "--install", build], check=True, capture_output=True)
    made = {p.name for p in (tmp_path / "in").rglob("*") if p.is_file()}
    assert {"lib" + hybrid.name + ".a", f"{hybrid.name}.pc", f"{hybrid.name}_model.h"} <= made
    pc = next((tmp_path / "in").rglob("*.pc")).read_text()
    assert f"-l{hybrid.name}" in pc and str(tmp_path / "in") in pc


@pytest.mark.slow
def test_export_and_compilation_stay_within_their_budget(tmp_path):
    model = cases.hybrid(100)
    # Processor time of Python and compiler together: the clock on the wall would measure what else
    # runs.
    start = sum(os.times()[:4])
    bundle = write_bundle(model, tmp_path / "big", use_cache=False)
    compiled.compile_library(bundle, tmp_path / "lib", "gcc", "-O2")
    assert sum(os.times()[:4]) - start < 10.0
    assert bundle.manifest["c"]["source_bytes"] < 3e6
