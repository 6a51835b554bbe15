"""C source of CasADi functions: CasADi's own generator, then what it leaves to be desired is
repaired in the text.

What `write_c` changes, each by name and with an error where the text is not as expected:

- dense and sparse matrix products get column-wise, `restrict` bodies (the generated triple loop
  does not vectorise);
- a function that has a kernel of its own (`CKernel`, e.g. a Gaussian process) gets that in place of
  the generated body;
- helpers become `static`; those and constants that nothing uses any more are dropped (they would
  fail -Werror);
- exported names get the prefix of the model, so that two models link into one program;
- in float builds literals and libm calls become float ones: no double arithmetic is left;
- parameters that a function does not use are named in it, and long lines are broken.

The result has no stdio, no malloc and no variables with static storage that change; it compiles
with `-std=c99 -Wall -Wextra -Wpedantic -Werror`. `-std=c99` forbids gcc to
fuse multiplication and addition; for speed add `-O3 -march=native -ffp-contract=fast
-fno-math-errno` (`FAST_FLAGS`).
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

import casadi as ca
import numpy as np

from greybox.errors import ModelError
from greybox.files import write_atomic
from mpc_export.c_kernels_products import PRODUCTS
from mpc_export.c_text import all_used, broken, compared

Real = Literal["double", "float"]
RESTRICT = """#if defined(__cplusplus) && !defined(restrict)
#define restrict __restrict  /* C++ has no such word, its compilers have this one */
#endif

"""
STRICT_FLAGS = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror")
_ON_THIS_MACHINE = ("-march=native", "-ffp-contract=fast", "-fno-math-errno")
FAST_FLAGS = ("-std=c99", "-O3", *_ON_THIS_MACHINE)
GENERATED_FLAGS = ("-std=c99", "-O1", "-ftree-vectorize", *_ON_THIS_MACHINE)
"""For what is run from here at once: straight-line code is as fast as with FAST_FLAGS, and compiled
several times sooner; loops of products and kernels still become vectors."""
LIBM = (
    "acos|acosh|asin|asinh|atan|atan2|atanh|cbrt|ceil|copysign|cos|cosh|erf|erfc|exp|exp2|expm1|fabs|floor|fmax|fmin|fmod|"
    "hypot|log|log10|log1p|log2|pow|remainder|rint|round|sin|sinh|sqrt|tan|tanh|tgamma|trunc"
)
"""Names of C99's math functions that have an f-form for float."""

_SUFFIXES = (
    "checkout|release|incref|decref|n_in|n_out|default_in|name_in|name_out|sparsity_in|sparsity_out|work|work_bytes|"
    "alloc_mem|init_mem|free_mem"
)
_FORBIDDEN = ("#include <stdio", "malloc(", "#error")


class CKernel(Protocol):
    """C that computes a whole CasADi function in place of its generated body."""

    @property
    def name(self) -> str:
        """Name of the CasADi function that it stands for."""

    def c_source(self, symbol: str, real: Real) -> tuple[dict[str, str], str]:
        """(shared, body). `body` defines `static int symbol(const casadi_real** arg, casadi_real**
        res, casadi_int* iw, casadi_real* w, int mem)` and may use casadi_real, casadi_int and
        <math.h>; `shared` are static definitions that it needs, by name, in order: one of each name
        goes into the file."""


@dataclass(frozen=True, kw_only=True)
class Port:
    """One argument or result: its name and its sparsity, compressed columns as CasADi and
    scipy.sparse.csc have them."""

    name: str
    rows: int
    columns: int
    colind: tuple[int, ...]
    row: tuple[int, ...]

    @property
    def nnz(self) -> int:
        """Numbers that the C function reads or writes for it, column by column."""
        return len(self.row)

    @property
    def dense(self) -> bool:
        """Whether every element is stored."""
        return self.nnz == self.rows * self.columns


@dataclass(frozen=True, kw_only=True)
class CFunction:
    """One exported function: `int symbol(const real** arg, real** res, int* iw, real* w, int mem)`.

    The sizes are those of the arrays arg, res (pointers), iw (integers) and w (reals) that the
    caller owns. `mem` is 0. A null pointer in arg means zeros, one in res that the result is not
    wanted.
    """

    name: str
    symbol: str
    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    sz_arg: int
    sz_res: int
    sz_iw: int
    sz_w: int


@dataclass(frozen=True, kw_only=True)
class CSource:
    """What `write_c` wrote. `kernels` names the functions whose body is a kernel of our own."""

    source: Path
    header: Path
    prefix: str
    real: Real
    integer: str
    functions: tuple[CFunction, ...]
    kernels: tuple[str, ...]


def write_c(
    functions: Sequence[ca.Function],
    folder: Path,
    *,
    prefix: str,
    real: Real = "double",
    kernels: Sequence[CKernel] = (),
) -> CSource:
    """Write `<prefix>.c` and `<prefix>.h` into `folder`; every CasADi function f is exported as
    `<prefix>_f`.

    `kernels` replace the functions of their name, exported or called by an exported one; those that
    do not occur are ignored. Integers are CasADi's `long long int` with double (casadi.external
    loads the library) and `int` with float. Raises `ModelError` for a prefix that is no C
    identifier, for names given twice, and for functions that need stdio or malloc (solvers).
    """
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", prefix):
        raise ModelError(
            "the prefix is not a C identifier",
            got=repr(prefix),
            fix="letters, digits and underscores",
        )
    names = [f.name() for f in functions]
    double = sorted({n for n in names if names.count(n) > 1})
    if double:
        raise ModelError(f"functions given twice: {', '.join(double)}")
    integer = "long long int" if real == "double" else "int"
    text, used = _with_kernels(_generated(functions, prefix, real, integer), kernels, real)
    for name, body in PRODUCTS.items():
        if f"#define {name} " in text:
            text = _replaced(text, name, body)
    text = _pruned(_with_static_helpers(text))
    for token in _FORBIDDEN:
        if token in text:
            raise ModelError(
                f"generated C contains {token}", fix="export model functions, not solvers"
            )
    if real == "float":
        text = single_precision(text)
    described = tuple(_describe(f, prefix, text) for f in functions)
    text = _exported(text, {n: f"{prefix}_{n}" for n in names})
    text = broken(compared(all_used(text))).strip()
    text = f'#include "{prefix}.h"\n\n{RESTRICT if "restrict" in text else ""}{text}\n'
    source, header = Path(folder) / f"{prefix}.c", Path(folder) / f"{prefix}.h"
    source.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(source, text.encode())
    write_atomic(header, broken(_header(prefix, real, integer, described)).encode())
    return CSource(
        source=source,
        header=header,
        prefix=prefix,
        real=real,
        integer=integer,
        functions=described,
        kernels=used,
    )


def _generated(functions: Sequence[ca.Function], prefix: str, real: Real, integer: str) -> str:
    """What CasADi writes."""
    generator = ca.CodeGenerator(
        f"{prefix}.c",
        {"verbose": False, "casadi_real": real, "casadi_int": integer, "with_header": False},
    )
    for f in functions:
        generator.add(f)
    return str(generator.dump())


def single_precision(text: str) -> str:
    """C text with every floating literal and every libm call in its float form; comments and
    strings stay.

    A literal below float's range becomes 0, one above it the infinity.
    """
    token = re.compile(
        r"(?P<skip>/\*.*?\*/|\"[^\"\n]*\"|^\s*#[^\n]*)"
        r"|(?<![\w.])(?P<number>(?:\d+\.\d*|\.\d+)(?:[eE][+-]?\d+)?|\d+[eE][+-]?\d+)(?![\w.])"
        rf"|(?<![\w.])(?P<call>{LIBM})(?=\s*\()",
        re.DOTALL | re.MULTILINE,
    )

    def swap(match: re.Match[str]) -> str:
        if match["skip"] is not None:
            return match["skip"]
        if match["call"] is not None:
            return f"{match['call']}f"
        value = float(match["number"])
        with np.errstate(all="ignore"):
            single = np.float32(value)
        if not np.isfinite(single):
            return "INFINITY"
        if value != 0.0 and abs(single) < np.finfo(np.float32).tiny:
            return "0.f"
        return f"{match['number']}f"

    return token.sub(swap, text)


# -------------------------------------------------------------------------------- surgery by name


def _definition(text: str, name: str) -> tuple[int, int]:
    """Where the definition of function `name` starts and ends. Raises `ModelError` unless there is
    exactly one."""
    heads = [m for m in re.finditer(rf"{name} ?\(", text) if _defines(text, m)]
    if len(heads) != 1:
        raise ModelError(
            f"generated C defines {name} {len(heads)} times",
            expected="once",
            fix="report the CasADi version",
        )
    start, at = text.rfind("\n", 0, heads[0].start()) + 1, text.index("{", heads[0].end()) + 1
    depth = 1
    for brace in re.compile(r"[{}]").finditer(text, at):
        depth += 1 if brace[0] == "{" else -1
        if depth == 0:
            end = brace.end()
            return start, end + 1 if text[end : end + 1] == "\n" else end
    raise ModelError(f"generated C does not end {name}", fix="report the CasADi version")


def _defines(text: str, name: re.Match[str]) -> bool:
    """Whether a name with its opening bracket starts a definition, not a call or a declaration."""
    before = text[text.rfind("\n", 0, name.start()) + 1 : name.start()]
    after = re.compile(r"[^;{}]*\)\s*\{").match(text, name.end())
    return re.fullmatch(r"[a-z][\w \*]*[ \*]", before) is not None and after is not None


def _replaced(text: str, name: str, body: str) -> str:
    start, end = _definition(text, name)
    return text[:start] + body + text[end:]


def _with_kernels(text: str, kernels: Sequence[CKernel], real: Real) -> tuple[str, tuple[str, ...]]:
    used: list[str] = []
    shared: dict[str, str] = {}
    named = re.findall(r"^/\* (\w+):\(.*\) \*/\nstatic int (casadi_f\d+)\(", text, re.MULTILINE)
    for kernel in kernels:
        found = [symbol for name, symbol in named if name == kernel.name]
        if len(found) > 1:
            raise ModelError(
                f"{len(found)} different functions are named {kernel.name}", expected="one"
            )
        if found:
            definitions, body = kernel.c_source(found[0], real)
            shared = {**shared, **{k: v for k, v in definitions.items() if k not in shared}}
            text = _replaced(text, found[0], body)
            used.append(kernel.name)
    first = re.search(r"^/\* \w+:\(.*\) \*/\nstatic int casadi_f", text, re.MULTILINE)
    if shared and first:
        text = text[: first.start()] + "\n".join(shared.values()) + "\n" + text[first.start() :]
    return text, tuple(used)


def _with_static_helpers(text: str) -> str:
    return re.sub(
        r"^((?:void|int|casadi_real|casadi_int) casadi_\w+\()",
        r"static \1",
        text,
        flags=re.MULTILINE,
    )


def _pruned(text: str) -> str:
    """Without static constants and helpers that are mentioned only where they are defined."""
    define = re.compile(r"^#define (casadi_\w+) .*\n", re.MULTILINE)
    constant = re.compile(r"^static const casadi_(?:real|int) (casadi_\w+)\[[^;]*;\n", re.MULTILINE)
    helper = re.compile(r"^static (?:void|int|casadi_real|casadi_int) (casadi_\w+)\(", re.MULTILINE)
    while True:
        body = define.sub("", text)
        count = Counter(re.findall(r"\bcasadi_\w+", body))
        idle = {n for n in (*constant.findall(body), *helper.findall(body)) if count[n] == 1}
        if not idle:
            return text
        for name in idle & set(helper.findall(body)):
            text = _replaced(text, name, "")
        for pattern in (constant, define):
            text = pattern.sub(lambda m, idle=idle: "" if m[1] in idle else m[0], text)  # type: ignore[misc]


def _exported(text: str, symbols: Mapping[str, str]) -> str:
    """With the exported functions of each name renamed to those of its symbol."""
    changed: set[str] = set()

    def rename(match: re.Match[str]) -> str:
        name = match[2]
        if name not in symbols:
            name = re.sub(rf"_(?:{_SUFFIXES})$", "", name)
        if name not in symbols:
            return match[0]
        changed.add(name)
        return f"{match[1]}{symbols[name]}{match[2][len(name) :]}("

    text = re.sub(r"^(CASADI_SYMBOL_EXPORT [\w \*]*?)(\w+)\(", rename, text, flags=re.MULTILINE)
    for name in symbols.keys() - changed:
        raise ModelError(f"generated C does not export {name}", fix="report the CasADi version")
    return text


# ------------------------------------------------------------------------------------ description


def _port(name: str, sparsity: ca.Sparsity) -> Port:
    return Port(
        name=name,
        rows=sparsity.size1(),
        columns=sparsity.size2(),
        colind=tuple(sparsity.colind()),
        row=tuple(sparsity.row()),
    )


def _describe(f: ca.Function, prefix: str, text: str) -> CFunction:
    name = f.name()
    start, end = _definition_of_work(text, name)
    sizes = {k: int(v) for k, v in re.findall(r"\*(sz_\w+) = (\d+);", text[start:end])}
    return CFunction(
        name=name,
        symbol=f"{prefix}_{name}",
        inputs=tuple(_port(f.name_in(i), f.sparsity_in(i)) for i in range(f.n_in())),
        outputs=tuple(_port(f.name_out(i), f.sparsity_out(i)) for i in range(f.n_out())),
        **{k: sizes[k] for k in ("sz_arg", "sz_res", "sz_iw", "sz_w")},
    )


def _definition_of_work(text: str, name: str) -> tuple[int, int]:
    start = text.find(f"\nCASADI_SYMBOL_EXPORT int {name}_work(")
    if start < 0:
        raise ModelError(
            f"generated C states no work sizes of {name}", fix="report the CasADi version"
        )
    return start, text.index("\n}", start)


def _shape(port: Port) -> str:
    size = f"{port.rows}" if port.columns == 1 else f"{port.rows} x {port.columns}"
    return f"{port.name}[{size}]" if port.dense else f"{port.name}[{size}, {port.nnz} stored]"


def _header(prefix: str, real: Real, integer: str, functions: Sequence[CFunction]) -> str:
    guard = f"{prefix.upper()}_H"
    lines = [
        f"/* {prefix}: functions generated by greybox with CasADi {ca.CasadiMeta.version()}, in "
        f"{real}.",
        "   Every function: arg, res are arrays of pointers, iw and w work space, all owned by the "
        "caller, with the sizes",
        "   below; mem is 0; the return value is 0 unless the evaluation failed. A null pointer in "
        "arg means zeros, one in",
        "   res that the result is not wanted. Matrices are stored column by column. Reentrant: no "
        "static variables. */",
        f"#ifndef {guard}",
        f"#define {guard}",
        "",
        "#ifdef __cplusplus",
        'extern "C" {',
        "#endif",
        "",
        f"typedef {real} {prefix}_real;",
        f"typedef {integer} {prefix}_int;",
    ]
    for f in functions:
        upper = f.symbol.upper()
        lines += [
            "",
            f"/* {f.name}({', '.join(map(_shape, f.inputs))}) -> "
            f"{', '.join(map(_shape, f.outputs))} */",
        ]
        lines += [
            f"#define {upper}_{k.upper()} {getattr(f, k)}"
            for k in ("sz_arg", "sz_res", "sz_iw", "sz_w")
        ]
        lines += [
            f"int {f.symbol}(const {prefix}_real** arg, {prefix}_real** res, {prefix}_int* iw, "
            f"{prefix}_real* w, int mem);"
        ]
    lines += ["", "#ifdef __cplusplus", "}", "#endif", "", f"#endif /* {guard} */", ""]
    return "\n".join(lines)
