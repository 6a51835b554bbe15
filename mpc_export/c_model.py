"""The readable C around the generated functions: header with ordering tables, wrapper, self-test,
CMake, C++ example.

The generated functions keep CasADi's calling convention (`NAME.h`); `NAME_model.h` gives each of
them a plain C function with named arguments, numbers as constant arrays, and return codes.
Everything is in one translation unit without state.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from greybox.symbolic import FloatArray, Layout
from mpc_export.c_code import CFunction, CSource, Port
from mpc_export.c_text import broken
from mpc_export.functions import ModelFunctions
from mpc_export.golden import FARTHEST, Golden
from mpc_export.model_parts import Reading, readings, shared
from mpc_export.template import filled

CODES = (
    ("OK", "results are written"),
    (
        "OUT_OF_RANGE",
        "results are written, but a command is out of its bounds, the state's quaternion is not of "
        "unit length, or a measured one is shorter than half of that or longer than twice: then it "
        "counts as missing",
    ),
    (
        "NOT_FINITE_INPUT",
        "an argument is NaN or infinite, or a measurement that is said to be there: nothing is "
        "written",
    ),
    ("NOT_FINITE_RESULT", "results are written, but one of them is NaN or infinite"),
    ("FAILED", "the evaluation failed"),
)
"""Return codes by number."""
FRESH = (
    "no errors of parameters, and the learned error fresh at every sample: too narrow beyond a few "
    "samples, where consider_step holds"
)
WORTH = {
    "covariance_step": FRESH,
    "covariance_feedback": FRESH,
    "adapt_step": "V: parameters, and what they add to the state's errors; the whole covariance of "
    "the state is covariance_0 + its block",
}
"""What the covariance of a function holds and what it leaves out."""
MEASURED = frozenset({"y", "there"})
"""Arguments of a function that measures."""
LISTED = 120
"""A layout longer than this (the weights of a learned part) is not listed name by name."""


OUTSIDE = frozenset("UPY")
"""Vectors that a caller fills or reads as signals of the machine: the header says what they mean."""


def identifiers(names: Sequence[str]) -> list[str]:
    """Signals' names as parts of C macros, no two the same: in capitals; where two have the same
    (M and m), each in its own letters; where these are the same, too, with its number."""
    plain = [re.sub(r"[^A-Za-z0-9]+", "_", n).strip("_") for n in names]
    capitals = Counter(p.upper() for p in plain)
    out = [p.upper() if capitals[p.upper()] == 1 else p for p in plain]
    taken = Counter(out)
    numbered = [f"{p}_{i}".strip("_") for i, p in enumerate(plain)]
    found = [p if p and taken[p] == 1 else n for p, n in zip(out, numbered, strict=True)]
    return found if len({*found}) == len(found) else numbered


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
            "CMakeLists.txt": filled("model/CMakeLists.txt", n=n),
            f"{n}.pc.in": self._pkg_config(),
        }

    @property
    def work(self) -> dict[str, int]:
        """Largest work sizes over all functions."""
        sizes = ("sz_arg", "sz_res", "sz_iw", "sz_w")
        return {k: max((getattr(f, k) for f in self.source.functions), default=0) for k in sizes}

    # -------------------------------------------------------------------------------------- header

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
                "adapted parameters, then what the state's errors have beyond covariance_0 (rows and "
                "columns of V)",
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
            meant = [""] * len(names)
            if letter in OUTSIDE and isinstance(layout, Layout):
                meant = [s.meaning for s in layout]
            out += ["", f"/* {what} */", f"#define {self.upper}_N_{letter} {len(names)}"]
            if len(names) > LISTED:
                out.append(f"/* {names[0]} .. {names[-1]}: the manifest lists them all */")
                continue
            called = identifiers(names)
            for i, (n, unit, meaning) in enumerate(zip(names, units, meant, strict=True)):
                out += [f"/* {_comment(f'{n}: {meaning}')} */"] * bool(meaning)
                said = f"  /* [{_comment(unit)}] */" if unit else ""
                out.append(f"#define {self.upper}_{letter}_{called[i]} {i}{said}")
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
            "process_noise": (
                "n_d x n_d, Q per sample of predictions ahead, at least that of the filter",
                f.noise.process,
            ),
            "gain": ("n_d x n_e, stationary gain K of the identified filter", f.noise.gain),
            "theta_covariance": ("n_theta x n_theta, of the uncertain parameters", f.covariance),
            "adapted_covariance": (
                "n_a x n_a, before a flight: a start for V, the state's block without covariance_0",
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
        numbers = self._numbers().items()
        signatures = []
        for c in self.source.functions:
            shape = (
                ", ".join(_shape(p) for p in c.inputs)
                + " -> "
                + ", ".join(_shape(p) for p in c.outputs)
            )
            worth = f"\n   {WORTH[c.name]}" if c.name in WORTH else ""
            signatures += [f"/* {shape}{worth} */", f"{self._prototype(c)};"]
        return filled(
            "model/header.h",
            n=n,
            up=up,
            what=_comment(f.name),
            version=self.version,
            dt=f"{f.dt:g}",
            abi=f"{self.abi:08x}",
            dt_number=_number(f.dt),
            own_states=f.own_states,
            tables="\n".join(self._tables()),
            codes="\n".join(
                f"#define {up}_{code} {i}  /* {why} */" for i, (code, why) in enumerate(CODES)
            ),
            work="\n".join(f"#define {up}_{k.upper()} {v}" for k, v in self.work.items()),
            numbers="\n".join(
                f"extern const {self.real} {n}_{k}[{v.size}];  /* {why} */"
                for k, (why, v) in numbers
            ),
            functions="\n".join(signatures),
        )

    # ------------------------------------------------------------------------------------- wrapper

    def _wrapper(self) -> str:
        numbers = []
        for name, (_, values) in self._numbers().items():
            head = f"const {self.real} {self.name}_{name}[{values.size}] = {{"
            numbers += [head, *_wrapped(values, self.source.real), "};"]
        return filled(
            "model/wrapper.c",
            n=self.name,
            up=self.upper,
            version=self.version,
            numbers="\n".join(numbers),
            attitude=self._unit_quaternion(),
            commands=self._commands_in_bounds(),
            seen=self._seen(),
            functions="\n".join(self._evaluation(f) for f in self.source.functions),
        )

    def _seen(self) -> str:
        """C that says whether every measurement that counts is a number; empty where no function
        measures."""
        if not any({p.name for p in f.inputs if p.nnz} >= MEASURED for f in self.source.functions):
            return ""
        f = self.functions
        columns = f.sampled.dynamics.innovation_columns
        needs = [[int(c in own) for c in f.outputs.names] for own in columns]
        with_ = [[int(j in own) for j in range(len(columns))] for own in shared(columns)]
        return filled(
            "model/seen.c",
            real=self.real,
            up=self.upper,
            needs=_table(needs),
            together=_table(with_),
            possible="".join(self._possible(read) for read in readings(f.sampled.dynamics)),
        )

    def _possible(self, read: Reading) -> str:
        """C that returns 0 where this reading counts and is too short or too long."""
        square = " + ".join(f"y[{i}] * y[{i}]" for i in read.columns)
        low, high = (self._literal(v**2) for v in (read.shortest, read.longest))
        return (
            f"  if (counts(there, {read.innovations[0]})) {{\n"
            f"    const {self.real} square = {square};\n"
            f"    if (!(square >= {low} && square <= {high})) return 0;\n"
            "  }\n"
        )

    def _unit_quaternion(self) -> str:
        """Lines that return 0 for a state whose quaternion is not of unit length."""
        states = self.functions.states.names
        if "attitude.w" not in states:
            return "  (void)x;"
        return "\n".join(
            [
                f"  const {self.real} *q = x + {states.index('attitude.w')};",
                f"  const {self.real} norm = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * "
                "q[3];",
                f"  if (norm < {self._literal(0.98)} || norm > {self._literal(1.02)}) return 0;",
            ]
        )

    def _commands_in_bounds(self) -> str:
        """Lines that return 0 for commands out of their bounds."""
        if not len(self.functions.inputs):
            return "  (void)u;"
        return "\n".join(
            [
                "  {",
                "    int i;",
                f"    for (i = 0; i < {self.upper}_N_U; ++i) {{",
                f"      if (u[i] < {self.name}_u_lower[i] || u[i] > {self.name}_u_upper[i]) return "
                "0;",
                "    }",
                "  }",
            ]
        )

    def _evaluation(self, f: CFunction) -> str:
        """The plain C function around a generated one."""
        up = self.upper
        lines = ["", f"{self._prototype(f)} {{"]
        # A measurement that is missing may be NaN, and so is its innovation.
        checked = [p for p in f.inputs if p.nnz and p.name != "y"]
        if checked:
            test = " || ".join(f"!finite_all({p.name}, {p.nnz})" for p in checked)
            lines.append(f"  if ({test}) return {up}_NOT_FINITE_INPUT;")
        if {p.name for p in f.inputs if p.nnz} >= MEASURED:
            lines.append(f"  if (!finite_seen(y, there)) return {up}_NOT_FINITE_INPUT;")
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
            if {p.name for p in f.inputs if p.nnz} >= MEASURED:
                lines.append(f"  if (!possible_seen(y, there)) return {up}_OUT_OF_RANGE;")
            lines.append(
                f"  return x == 0 || u == 0 || in_range(x, u) ? {up}_OK : {up}_OUT_OF_RANGE;"
            )
        else:
            lines.append(f"  return {up}_OK;")
        return "\n".join([*lines, "}"])

    def _literal(self, value: float) -> str:
        return _number(value) + ("f" if self.source.real == "float" else "")

    # ----------------------------------------------------------------------------------- self-test

    def _selftest(self) -> str:
        """A program that compares every function with golden vectors; the vectors are in its
        text."""
        return filled(
            "model/selftest.c",
            n=self.name,
            up=self.upper,
            version=self.version,
            most=max(self._most(), 1),
            limit=f"{1e-10 if self.source.real == 'double' else 1e-4:g}",
            tests="".join(
                f"\n{self._golden_test(f, i)}\n" for i, f in enumerate(self.source.functions)
            ),
            calls="\n".join(f"  test_{i}();" for i in range(len(self.source.functions))),
            count=len(self.source.functions),
        )

    def _golden_test(self, f: CFunction, i: int) -> str:
        """Usual flight, and the farthest out. Its name has a number: no name of a bundle makes it
        one of the bundle's."""
        golden = next(g for g in self.golden if g.name == f.name)
        count = next(iter(golden.results.values())).shape[0]
        lines = [f"/* {f.name} */", f"static void test_{i}(void) {{", "  int code;"]
        for row in sorted({min(1, count - 1), min(FARTHEST, count - 1)}):
            lines += ["  {", *self._golden_call(f, golden, row), "  }"]
        return "\n".join([*lines, "}"])

    def _golden_call(self, f: CFunction, golden: Golden, row: int) -> list[str]:
        """One call with its arguments and what must come out."""
        lines, places, at = [], [], 0
        for p in f.inputs:
            if p.nnz:
                head = f"    static const {self.real} {p.name}[{p.nnz}] = {{"
                lines += [
                    head,
                    *_wrapped(golden.arguments[p.name][row], self.source.real),
                    "    };",
                ]
        for p in f.outputs:
            places.append(f"result + {at}" if p.nnz else "0")
            at += p.nnz
            if p.nnz:
                head = f"    static const double want_{p.name}[{p.nnz}] = {{"
                lines += [head, *_wrapped(golden.results[p.name][row], "double"), "    };"]
        given = [p.name if p.nnz else "0" for p in f.inputs]
        lines.append(
            f"    code = {self.name}_eval_{f.name}({', '.join([*given, *places])}, &work);"
        )
        for p, place in zip(f.outputs, places):
            if p.nnz:
                gap = (
                    f"compare({place}, want_{p.name}, {p.nnz}, "
                    f"{_number(scale_of(golden.results[p.name]))})"
                )
                lines.append(f'    judge("{f.name}, {p.name}", code, {gap});')
        return lines

    def _most(self) -> int:
        return max((sum(p.nnz for p in f.outputs) for f in self.source.functions), default=1)

    # ------------------------------------------------------------------------------------ the rest

    def _example(self) -> str:
        p = f"{self.name}_p_identified" if len(self.functions.parameters) else "nullptr"
        return filled("model/example.cpp", n=self.name, up=self.upper, p=p)

    def _pkg_config(self) -> str:
        what = re.sub(r"[^A-Za-z0-9 _.,:+-]", "_", self.functions.name)
        return filled("model/model.pc.in", n=self.name, what=what, version=self.version)

    def write(self, folder: Path) -> None:
        """Write all texts into the folder."""
        for name, text in self.texts().items():
            own = broken(text) if name.endswith((".c", ".h")) else text
            (folder / name).write_text(own, encoding="utf-8")


def scale_of(results: npt.ArrayLike) -> float:
    """Scale of an output: its largest size over the golden points (1e-30 for one that is zero
    everywhere)."""
    values = np.abs(np.asarray(results, dtype=float))
    return max(float(values.max(initial=0.0)), 1e-30)


def _table(rows: Sequence[Sequence[int]]) -> str:
    """A matrix as an initialiser in C."""
    return ",\n".join(f"  {{{', '.join(map(str, row))}}}" for row in rows)


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


def sizes_of(source: CSource) -> dict[str, dict[str, int]]:
    """Work sizes of every function, for the manifest."""
    return {
        f.name: {k: getattr(f, k) for k in ("sz_arg", "sz_res", "sz_iw", "sz_w")}
        for f in source.functions
    }
