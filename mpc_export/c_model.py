"""The readable C around the generated functions: header with ordering tables, wrapper, self-test, CMake, C++ example.

The generated functions keep CasADi's calling convention (`NAME.h`); `NAME_model.h` gives each of them a plain C function
with named arguments, numbers as constant arrays, and return codes. Everything is in one translation unit without state.
The file is long because these texts share one list of functions and numbers, and are made in one go.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from greybox.errors import ModelError
from greybox.symbolic import FloatArray, Layout
from mpc_export.c_code import CFunction, CSource, Port
from mpc_export.functions import ModelFunctions
from mpc_export.golden import FARTHEST, Golden

CODES = (
    ("OK", "results are written"),
    (
        "OUT_OF_RANGE",
        "results are written, but a command is out of its bounds or the quaternion is not of unit length",
    ),
    ("NOT_FINITE_INPUT", "an argument is NaN or infinite: nothing is written"),
    ("NOT_FINITE_RESULT", "results are written, but one of them is NaN or infinite"),
    ("FAILED", "the evaluation failed"),
)
"""Return codes by number."""
KEYWORDS = frozenset(
    {
        "auto",
        "break",
        "case",
        "char",
        "const",
        "continue",
        "default",
        "do",
        "double",
        "else",
        "enum",
        "extern",
        "float",
        "for",
        "goto",
        "if",
        "inline",
        "int",
        "long",
        "register",
        "restrict",
        "return",
        "short",
        "signed",
        "sizeof",
        "static",
        "struct",
        "switch",
        "typedef",
        "union",
        "unsigned",
        "void",
        "volatile",
        "while",
        "class",
        "new",
        "delete",
        "namespace",
        "template",
        "this",
        "throw",
        "try",
        "catch",
        "bool",
        "true",
        "false",
        "private",
        "public",
        "protected",
        "virtual",
        "operator",
        "using",
    }
)
TAKEN = frozenset(
    {
        "all",
        "c",
        "clean",
        "depend",
        "edit_cache",
        "help",
        "install",
        "m",
        "package",
        "rebuild_cache",
        "test",
    }
)
"""CMake targets of these names there are already; lib`c` and lib`m` are the system's."""
LISTED = 120
"""A layout longer than this (the weights of a learned part) is not listed name by name."""


def check_name(name: str) -> str:
    """The name, if C and C++ take it as the prefix of everything. Raises `ModelError`."""
    if (
        not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,40}", name)
        or name in KEYWORDS
        or name.startswith("casadi")
    ):
        raise ModelError(
            "the bundle's name is not a C identifier",
            expected="letters, digits and underscores, a letter first",
            got=repr(name),
            fix="--name quad",
        )
    if name.lower() in TAKEN:
        raise ModelError(
            "the bundle's name is taken in C builds", got=repr(name), fix="--name quad"
        )
    return name


def identifier(name: str) -> str:
    """A signal's name as part of a C macro."""
    return re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_").upper()


def abi_number(functions: ModelFunctions, source: CSource) -> int:
    """32 bits that change whenever the layout of an argument or a result does."""
    f = functions
    layouts = [
        f.states,
        f.inputs,
        f.parameters,
        f.outputs,
        f.error_states,
        f.innovations,
        f.features,
        f.learned,
        f.targets,
    ]
    text = repr([(s.name, s.unit) for layout in layouts for s in layout]) + repr(
        list(f.covariance_names)
    )
    text += repr(list(functions.adapted.names))
    text += repr(
        [
            (f.name, [(p.name, p.rows, p.columns) for p in (*f.inputs, *f.outputs)])
            for f in source.functions
        ]
    )
    return int(hashlib.sha256((text + source.real).encode()).hexdigest()[:8], 16)


class CModel:
    """The texts of one bundle's c/ folder besides the generated functions."""

    def __init__(
        self, functions: ModelFunctions, source: CSource, version: str, golden: Sequence[Golden]
    ) -> None:
        self.functions, self.source, self.version, self.golden = functions, source, version, golden
        self.name, self.upper, self.real = (
            source.prefix,
            source.prefix.upper(),
            f"{source.prefix}_real",
        )
        self.abi = abi_number(functions, source)

    def texts(self) -> dict[str, str]:
        """File name -> content."""
        n = self.name
        return {
            f"{n}_model.h": self._header(),
            f"{n}_model.c": self._wrapper(),
            f"{n}_selftest.c": self._selftest(),
            f"{n}_example.cpp": self._example(),
            "CMakeLists.txt": self._cmake(),
            f"{n}.pc.in": self._pkg_config(),
        }

    @property
    def work(self) -> dict[str, int]:
        """Largest work sizes over all functions."""
        sizes = ("sz_arg", "sz_res", "sz_iw", "sz_w")
        return {k: max((getattr(f, k) for f in self.source.functions), default=0) for k in sizes}

    # ------------------------------------------------------------------------------------------------ header

    def _tables(self) -> list[str]:
        f, out = self.functions, []
        for letter, what, layout in (
            ("X", "states x", f.states),
            ("D", "error states (rows and columns of A, B, S, K)", f.error_states),
            ("U", "commands u", f.inputs),
            ("P", "run-time parameters p", f.parameters),
            ("Y", "outputs y", f.outputs),
            ("E", "innovations e, there", f.innovations),
            ("Z", "inputs z of the learned part", f.features),
            ("G", "learned outputs", f.learned),
            ("R", "targets r", f.targets),
            ("THETA", "uncertain parameters (columns of b)", f.covariance_names),
            (
                "A",
                "adapted parameters, then errors of the state (rows and columns of V)",
                f.adapted.names,
            ),
            (
                "H",
                "horizons of forecasts (columns of E, seen, sigma, scale)",
                f.calibration.horizons,
            ),
        ):
            names = layout.names if isinstance(layout, Layout) else tuple(layout)
            units = layout.units if isinstance(layout, Layout) else ("",) * len(names)
            out += ["", f"/* {what} */", f"#define {self.upper}_N_{letter} {len(names)}"]
            if len(names) > LISTED:
                out.append(f"/* {names[0]} .. {names[-1]}: the manifest lists them all */")
                continue
            out += [
                f"#define {self.upper}_{letter}_{identifier(n)} {i}{f'  /* [{_comment(unit)}] */' if unit else ''}"
                for i, (n, unit) in enumerate(zip(names, units))
            ]
        return out

    def _numbers(self) -> dict[str, tuple[str, FloatArray]]:
        """Constant arrays: name -> (meaning, values column by column)."""
        f = self.functions
        big = 1e30
        lower, upper = (np.nan_to_num(v, posinf=big, neginf=-big) for v in f.bounds)
        named = {
            "x_reference": ("state at which the stationary gain is linearised", f.reference[0]),
            "u_reference": ("command there", f.reference[1]),
            "p_identified": ("identified values of p", f.parameter_values),
            "x_scale": ("typical size of x: dimensionless = x / scale", f.scales[0]),
            "u_scale": ("typical size of u", f.scales[1]),
            "y_scale": ("typical size of y", f.scales[2]),
            "u_lower": ("lower bounds of u", lower),
            "u_upper": ("upper bounds of u", upper),
            "covariance_0": (
                "n_d x n_d, covariance of the filter's predicted state: a start for S",
                f.noise.covariance,
            ),
            "process_noise": ("n_d x n_d, Q per sample", f.noise.process),
            "gain": ("n_d x n_e, stationary gain K of the identified filter", f.noise.gain),
            "theta_covariance": ("n_theta x n_theta, of the uncertain parameters", f.covariance),
            "adapted_covariance": (
                "n_a x n_a, before a flight: a start for V",
                f.adapted.covariance,
            ),
            "calibration_sigma": (
                "n_e x n_h, stated standard deviations of forecasts' errors",
                f.calibration.sigma,
            ),
        }
        return {k: (why, np.ravel(v, order="F")) for k, (why, v) in named.items() if np.size(v)}

    def _prototype(self, f: CFunction) -> str:
        arguments = [f"const {self.real} *{p.name}" for p in f.inputs] + [
            f"{self.real} *{p.name}" for p in f.outputs
        ]
        return f"int {self.name}_eval_{f.name}({', '.join(arguments)}, {self.name}_work *work)"

    def _header(self) -> str:
        up, n, f = self.upper, self.name, self.functions
        lines = [
            f"/* {n}: {_comment(f.name)}, {f.dt:g} s a sample. Written by greybox {self.version}; see README.md.",
            "",
            "   Frames: world ENU (z up), body FLU (x forward, y left, z up); the unit quaternion (w, x, y, z) maps body",
            "   vectors to world; SI units. Matrices are stored column by column. Error states: README.md.",
            "",
            "   Reentrant and free of state: any number of threads may call any function at once, each with its own work.",
            "   No malloc, no stdio. Do not compile with -ffast-math: it would remove the checks for NaN. */",
            f"#ifndef {up}_MODEL_H",
            f"#define {up}_MODEL_H",
            "",
            f'#include "{n}.h"',
            "",
            f'#define {up}_GREYBOX_VERSION "{self.version}"',
            f"#define {up}_ABI 0x{self.abi:08x}u  /* changes with the layout of any argument or result */",
            f"#if defined({up}_EXPECTED_ABI) && {up}_EXPECTED_ABI != {up}_ABI",
            f'#error "{n}: another layout than the program was written for"',
            "#endif",
            "",
            f"#define {up}_SAMPLE_TIME {_number(f.dt)}  /* [s] */",
            f"#define {up}_N_OWN_STATES {f.own_states}  /* of x; f and f_jac_raw take these alone, the rest is history */",
            *self._tables(),
            "",
            "/* return codes */",
            *(f"#define {up}_{code} {i}  /* {why} */" for i, (code, why) in enumerate(CODES)),
            "",
            "/* work space of any one call, owned by the caller */",
            *(f"#define {up}_{k.upper()} {v}" for k, v in self.work.items()),
            "typedef struct {",
            f"  const {self.real} *arg[{up}_SZ_ARG + 1];",
            f"  {self.real} *res[{up}_SZ_RES + 1];",
            f"  {n}_int iw[{up}_SZ_IW + 1];",
            f"  {self.real} w[{up}_SZ_W + 1];",
            f"}} {n}_work;",
            "",
            "#ifdef __cplusplus",
            'extern "C" {',
            "#endif",
            "",
            f"/* {up}_ABI of the compiled library */",
            f"unsigned int {n}_abi(void);",
            "",
        ]
        for name, (why, values) in self._numbers().items():
            lines.append(f"extern const {self.real} {n}_{name}[{values.size}];  /* {why} */")
        lines += [
            "",
            "/* A null pointer for a result: it is not wanted. For p where the model has none: 0. Results must not overlap",
            "   arguments: x_next is another array than x. */",
        ]
        for c in self.source.functions:
            shape = (
                ", ".join(_shape(p) for p in c.inputs)
                + " -> "
                + ", ".join(_shape(p) for p in c.outputs)
            )
            lines += [f"/* {shape} */", f"{self._prototype(c)};"]
        lines += ["", "#ifdef __cplusplus", "}", "#endif", "", f"#endif /* {up}_MODEL_H */", ""]
        return "\n".join(lines)

    # ------------------------------------------------------------------------------------------------ wrapper

    def _wrapper(self) -> str:
        n, up, real = self.name, self.upper, self.real
        lines = [
            f"/* Plain C functions around the generated ones. Written by greybox {self.version}. */",
            f'#include "{n}_model.h"',
            "",
            f"unsigned int {n}_abi(void) {{ return {up}_ABI; }}",
            "",
        ]
        for name, (_, values) in self._numbers().items():
            lines += [
                f"const {real} {n}_{name}[{values.size}] = {{",
                *_wrapped(values, self.source.real),
                "};",
            ]
        lines += [
            "",
            f"static int finite_all(const {real} *v, int n) {{",
            "  int i;",
            "  if (v == 0) return 1;",
            "  for (i = 0; i < n; ++i) {",
            "    if (!(v[i] - v[i] == 0)) return 0;",
            "  }",
            "  return 1;",
            "}",
        ]
        states = self.functions.states.names
        lines += ["", f"static int in_range(const {real} *x, const {real} *u) {{"]
        if "attitude.w" in states:
            lines += [
                f"  const {real} *q = x + {states.index('attitude.w')};",
                f"  const {real} norm = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3];",
                f"  if (norm < {self._literal(0.98)} || norm > {self._literal(1.02)}) return 0;",
            ]
        else:
            lines.append("  (void)x;")
        if len(self.functions.inputs):
            lines += [
                "  {",
                "    int i;",
                f"    for (i = 0; i < {up}_N_U; ++i) {{",
                f"      if (u[i] < {n}_u_lower[i] || u[i] > {n}_u_upper[i]) return 0;",
                "    }",
                "  }",
            ]
        else:
            lines.append("  (void)u;")
        lines += ["  return 1;", "}"]
        for f in self.source.functions:
            lines += ["", f"{self._prototype(f)} {{"]
            # A measurement that is marked as missing may be NaN, and so is its innovation; x_next tells.
            checked = [p for p in f.inputs if p.nnz and p.name != "y"]
            if checked:
                test = " || ".join(f"!finite_all({p.name}, {p.nnz})" for p in checked)
                lines.append(f"  if ({test}) return {up}_NOT_FINITE_INPUT;")
            lines += [f"  work->arg[{i}] = {p.name};" for i, p in enumerate(f.inputs)]
            lines += [f"  work->res[{i}] = {p.name};" for i, p in enumerate(f.outputs)]
            lines.append(
                f"  if ({f.symbol}(work->arg, work->res, work->iw, work->w, 0)) return {up}_FAILED;"
            )
            results = [p for p in f.outputs if p.nnz and p.name != "e"]
            if results:
                test = " || ".join(f"!finite_all({p.name}, {p.nnz})" for p in results)
                lines.append(f"  if ({test}) return {up}_NOT_FINITE_RESULT;")
            if {"x", "u"} <= {p.name for p in f.inputs}:
                lines.append(
                    f"  return x == 0 || u == 0 || in_range(x, u) ? {up}_OK : {up}_OUT_OF_RANGE;"
                )
            else:
                lines.append(f"  return {up}_OK;")
            lines.append("}")
        return "\n".join([*lines, ""])

    def _literal(self, value: float) -> str:
        return _number(value) + ("f" if self.source.real == "float" else "")

    # ------------------------------------------------------------------------------------------------ self-test

    def _selftest(self) -> str:
        """A program that compares every function with golden vectors; the vectors are in its text."""
        n, up, real = self.name, self.upper, self.real
        limit = 1e-10 if self.source.real == "double" else 1e-4
        lines = [
            f"/* Self-test of {n}: every function at golden points. Returns 0 when all agree. Written by greybox",
            f"   {self.version}. */",
            "#include <stdio.h>",
            f'#include "{n}_model.h"',
            "",
            f"static {n}_work work;",
            f"static {real} result[{max(self._most(), 1)}];",
            "static double worst;",
            "static int failures;",
            "",
            f"static double compare(const {real} *got, const double *want, int n, double scale) {{",
            "  double most = 0;",
            "  int i;",
            "  for (i = 0; i < n; ++i) {",
            "    double gap = (double)got[i] - want[i];",
            "    if (gap < 0) gap = -gap;",
            "    if (!(gap == gap)) return 1e300;",
            "    if (gap > most) most = gap;",
            "  }",
            "  return most / scale;",
            "}",
            "",
            "static void judge(const char *name, int code, double gap) {",
            "  if (gap > worst) worst = gap;",
            f"  if (code > {up}_OUT_OF_RANGE || gap > {limit:g}) {{",
            "    ++failures;",
            '    printf("%s: code %d, difference %.2g of the output\'s scale\\n", name, code, gap);',
            "  }",
            "}",
        ]
        calls = []
        for f in self.source.functions:
            golden = next(g for g in self.golden if g.name == f.name)
            count = next(iter(golden.results.values())).shape[0]
            body = [f"static void test_{f.name}(void) {{", "  int code;"]
            # Usual flight, and the farthest out.
            for row in sorted({min(1, count - 1), min(FARTHEST, count - 1)}):
                body.append("  {")
                for p in f.inputs:
                    if p.nnz:
                        values = golden.arguments[p.name][row]
                        body += [
                            f"    static const {real} {p.name}[{p.nnz}] = {{",
                            *_wrapped(values, self.source.real),
                            "    };",
                        ]
                at = 0
                names = []
                for p in f.outputs:
                    names.append(f"result + {at}" if p.nnz else "0")
                    at += p.nnz
                for p in f.outputs:
                    if p.nnz:
                        values = golden.results[p.name][row]
                        body += [
                            f"    static const double want_{p.name}[{p.nnz}] = {{",
                            *_wrapped(values, "double"),
                            "    };",
                        ]
                given = [p.name if p.nnz else "0" for p in f.inputs]
                body.append(f"    code = {n}_eval_{f.name}({', '.join([*given, *names])}, &work);")
                for p, place in zip(f.outputs, names):
                    if p.nnz:
                        scale = scale_of(golden.results[p.name])
                        gap = f"compare({place}, want_{p.name}, {p.nnz}, {_number(scale)})"
                        body.append(f'    judge("{f.name}, {p.name}", code, {gap});')
                body.append("  }")
            lines += ["", *body, "}"]
            calls.append(f"  test_{f.name}();")
        lines += [
            "",
            "int main(void) {",
            f"  if ({n}_abi() != {up}_ABI) {{",
            '    printf("the library has another layout than the header\\n");',
            "    return 2;",
            "  }",
            *calls,
            f'  printf("{n}: %d functions, largest difference %.2g of the output\'s scale (limit {limit:g}): %s\\n",',
            f'         {len(calls)}, worst, failures ? "FAILED" : "passed");',
            "  return failures ? 1 : 0;",
            "}",
            "",
        ]
        return "\n".join(lines)

    def _most(self) -> int:
        return max((sum(p.nnz for p in f.outputs) for f in self.source.functions), default=1)

    # ------------------------------------------------------------------------------------------------ the rest

    def _example(self) -> str:
        n, up = self.name, self.upper
        has_p = len(self.functions.parameters) > 0
        return f"""// How to use {n} from C++: one second of flight at the reference command, then its linearisation.
#include "{n}_model.h"

#include <array>
#include <cstdio>

int main() {{
  static {n}_work work;  // one per thread
  std::array<{n}_real, {up}_N_X> x{{}}, next{{}};
  std::array<{n}_real, {up}_N_D * {up}_N_D> a{{}};
  std::array<{n}_real, {up}_N_D * {up}_N_U> b{{}};
  for (int i = 0; i < {up}_N_X; ++i) x[i] = {n}_x_reference[i];
  const {n}_real *u = {n}_u_reference, *p = {f"{n}_p_identified" if has_p else "nullptr"};
  for (int k = 0; k * {up}_SAMPLE_TIME < 1.0; ++k) {{
    const int code = {n}_eval_f_d(x.data(), u, p, next.data(), &work);
    if (code > {up}_OUT_OF_RANGE) return code;
    x = next;
  }}
  const int code = {n}_eval_f_d_jac(x.data(), u, p, next.data(), a.data(), b.data(), nullptr, &work);
  std::printf("x[0] = %g after one second, A[0][0] = %g\\n", double(x[0]), double(a[0]));
  return code > {up}_OUT_OF_RANGE ? code : 0;
}}
"""

    def _cmake(self) -> str:
        n = self.name
        return f"""cmake_minimum_required(VERSION 3.10)
project({n} LANGUAGES C)
include(GNUInstallDirs)
if(NOT CMAKE_BUILD_TYPE)
  set(CMAKE_BUILD_TYPE Release)
endif()
add_library({n} {n}.c {n}_model.c)
set_target_properties({n} PROPERTIES C_STANDARD 99 C_STANDARD_REQUIRED ON POSITION_INDEPENDENT_CODE ON)
target_include_directories({n} PUBLIC $<BUILD_INTERFACE:${{CMAKE_CURRENT_SOURCE_DIR}}> $<INSTALL_INTERFACE:include>)
if(UNIX)
  target_link_libraries({n} PUBLIC m)
endif()
add_executable({n}_selftest {n}_selftest.c)
set_target_properties({n}_selftest PROPERTIES C_STANDARD 99)
target_link_libraries({n}_selftest PRIVATE {n})
enable_testing()
add_test(NAME {n}_selftest COMMAND {n}_selftest)
configure_file({n}.pc.in {n}.pc @ONLY)
install(TARGETS {n} DESTINATION ${{CMAKE_INSTALL_LIBDIR}})
install(FILES {n}.h {n}_model.h DESTINATION ${{CMAKE_INSTALL_INCLUDEDIR}})
install(FILES ${{CMAKE_CURRENT_BINARY_DIR}}/{n}.pc DESTINATION ${{CMAKE_INSTALL_LIBDIR}}/pkgconfig)
"""

    def _pkg_config(self) -> str:
        return f"""prefix=@CMAKE_INSTALL_PREFIX@
includedir=${{prefix}}/@CMAKE_INSTALL_INCLUDEDIR@
libdir=${{prefix}}/@CMAKE_INSTALL_LIBDIR@

Name: {self.name}
Description: {re.sub(r"[^A-Za-z0-9 _.,:+-]", "_", self.functions.name)}, written by greybox
Version: {self.version}
Cflags: -I${{includedir}}
Libs: -L${{libdir}} -l{self.name} -lm
"""

    def write(self, folder: Path) -> None:
        """Write all texts into the folder."""
        for name, text in self.texts().items():
            (folder / name).write_text(text, encoding="utf-8")


def scale_of(results: npt.ArrayLike) -> float:
    """Scale of an output: its largest size over the golden points (1e-30 for one that is zero everywhere)."""
    values = np.abs(np.asarray(results, dtype=float))
    return max(float(values.max(initial=0.0)), 1e-30)


def _shape(port: Port) -> str:
    return (
        f"{port.name}[{port.rows}]"
        if port.columns == 1
        else f"{port.name}[{port.rows} x {port.columns}]"
    )


def _number(value: float) -> str:
    text = repr(float(value))
    return text if any(c in text for c in ".en") else f"{text}.0"


def _wrapped(values: npt.ArrayLike, real: str) -> list[str]:
    """C initialisers, several to a line."""
    numbers = np.asarray(values, dtype=float).ravel()
    if real == "float":
        texts = [f"{_number(float(np.float32(_tame(v))))}f" for v in numbers]
    else:
        texts = [_number(v) for v in numbers]
    return ["    " + ", ".join(texts[i : i + 6]) + "," for i in range(0, len(texts), 6)]


def _tame(value: float) -> float:
    """Within float's range; a denormal becomes zero."""
    if math.isfinite(value) and abs(value) < float(np.finfo(np.float32).tiny):
        return 0.0
    return float(np.clip(value, -3e38, 3e38))


def _comment(text: str) -> str:
    """Text that ends no comment, begins none, and is no trigraph."""
    plain = re.sub(r"[^\x20-\x7e]", "_", text).replace("\\", "/")
    return re.sub(r"\?(?=\?)", "? ", re.sub(r"/(?=\*)|\*(?=/)", lambda m: f"{m[0]} ", plain))


def sizes_of(source: CSource) -> Mapping[str, Any]:
    """Work sizes of every function, for the manifest."""
    return {
        f.name: {k: getattr(f, k) for k in ("sz_arg", "sz_res", "sz_iw", "sz_w")}
        for f in source.functions
    }
