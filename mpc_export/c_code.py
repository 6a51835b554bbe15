"""C source of CasADi functions: CasADi's own generator, then what it leaves to be desired is repaired in the text.

What `write_c` changes, each by name and with an error where the text is not as expected:

- dense and sparse matrix products get column-wise, `restrict` bodies (the generated triple loop does not vectorise);
- a function that has a kernel of its own (`CKernel`, e.g. a Gaussian process) gets that in place of the generated body;
- helpers become `static`; those and constants that nothing uses any more are dropped (they would fail -Werror);
- exported names get the prefix of the model, so that two models link into one program;
- in float builds literals and libm calls become float ones: no double arithmetic is left.

The result has no stdio, no malloc and no variables with static storage that change; it compiles with
`-std=c99 -Wall -Wextra -Wpedantic -Werror -Wno-unused-parameter`. `-std=c99` forbids gcc to fuse multiplication and
addition; for speed add `-O3 -march=native -ffp-contract=fast` (`FAST_FLAGS`).
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

import casadi as ca
import numpy as np

from greybox.errors import ModelError
from greybox.files import write_atomic

Real = Literal["double", "float"]
STRICT_FLAGS = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-Wno-unused-parameter")
FAST_FLAGS = ("-std=c99", "-O3", "-march=native", "-ffp-contract=fast")
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

_MTIMES_DENSE = """\
static void casadi_mtimes_dense(const casadi_real* restrict x, casadi_int nrow_x, casadi_int ncol_x,
    const casadi_real* restrict y, casadi_int ncol_y, casadi_real* restrict z, casadi_int tr) {
  casadi_int i, j, k, l;
  if (tr) {
    for (i=0; i<ncol_y; ++i, y+=nrow_x, z+=ncol_x) {
      for (j=0; j<ncol_x; ++j) {
        const casadi_real* restrict c = x + j*nrow_x;
        casadi_real s[8] = {0}, r = 0;
        for (k=0; k+8<=nrow_x; k+=8) {
          for (l=0; l<8; ++l) s[l] += c[k+l]*y[k+l];
        }
        for (; k<nrow_x; ++k) r += c[k]*y[k];
        z[j] += r + (((s[0]+s[4]) + (s[1]+s[5])) + ((s[2]+s[6]) + (s[3]+s[7])));
      }
    }
  } else {
    for (i=0; i<ncol_y; ++i, y+=ncol_x, z+=nrow_x) {
      for (k=0; k+4<=ncol_x; k+=4) {
        const casadi_real* restrict a = x + k*nrow_x;
        const casadi_real* restrict b = a + nrow_x;
        const casadi_real* restrict c = b + nrow_x;
        const casadi_real* restrict d = c + nrow_x;
        const casadi_real ya = y[k], yb = y[k+1], yc = y[k+2], yd = y[k+3];
        for (j=0; j<nrow_x; ++j) z[j] += (a[j]*ya + b[j]*yb) + (c[j]*yc + d[j]*yd);
      }
      for (; k<ncol_x; ++k) {
        const casadi_real* restrict a = x + k*nrow_x;
        const casadi_real ya = y[k];
        for (j=0; j<nrow_x; ++j) z[j] += a[j]*ya;
      }
    }
  }
}
"""

_MTIMES = """\
static void casadi_mtimes(const casadi_real* restrict x, const casadi_int* sp_x, const casadi_real* restrict y,
    const casadi_int* sp_y, casadi_real* restrict z, const casadi_int* sp_z, casadi_real* restrict w, casadi_int tr) {
  const casadi_int *colind_x = sp_x+2, *row_x = sp_x + 2 + sp_x[1]+1;
  const casadi_int *colind_y = sp_y+2, *row_y = sp_y + 2 + sp_y[1]+1;
  const casadi_int *colind_z = sp_z+2, *row_z = sp_z + 2 + sp_z[1]+1;
  casadi_int cc, kk, k1;
  for (cc=0; cc<sp_z[1]; ++cc) {
    if (tr) {
      for (kk=colind_y[cc]; kk<colind_y[cc+1]; ++kk) w[row_y[kk]] = y[kk];
      for (kk=colind_z[cc]; kk<colind_z[cc+1]; ++kk) {
        const casadi_int from = colind_x[row_z[kk]], n = colind_x[row_z[kk]+1] - from;
        const casadi_int* r = row_x + from;
        const casadi_real* restrict c = x + from;
        casadi_real s = 0;
        if (n > 0 && r[n-1] - r[0] == n-1) {  /* a column without gaps needs no row numbers */
          const casadi_real* restrict v = w + r[0];
          casadi_real t[8] = {0};
          casadi_int l;
          for (k1=0; k1+8<=n; k1+=8) {
            for (l=0; l<8; ++l) t[l] += c[k1+l]*v[k1+l];
          }
          for (; k1<n; ++k1) s += c[k1]*v[k1];
          s += ((t[0]+t[4]) + (t[1]+t[5])) + ((t[2]+t[6]) + (t[3]+t[7]));
        } else {
          for (k1=0; k1<n; ++k1) s += c[k1]*w[r[k1]];
        }
        z[kk] += s;
      }
    } else {
      for (kk=colind_z[cc]; kk<colind_z[cc+1]; ++kk) w[row_z[kk]] = z[kk];
      for (kk=colind_y[cc]; kk<colind_y[cc+1]; ++kk) {
        const casadi_int from = colind_x[row_y[kk]], n = colind_x[row_y[kk]+1] - from;
        const casadi_int* r = row_x + from;
        const casadi_real* restrict c = x + from;
        const casadi_real s = y[kk];
        if (n > 0 && r[n-1] - r[0] == n-1) {
          casadi_real* restrict v = w + r[0];
          for (k1=0; k1<n; ++k1) v[k1] += c[k1]*s;
        } else {
          for (k1=0; k1<n; ++k1) w[r[k1]] += c[k1]*s;
        }
      }
      for (kk=colind_z[cc]; kk<colind_z[cc+1]; ++kk) z[kk] = w[row_z[kk]];
    }
  }
}
"""

_BETTER = {"casadi_mtimes_dense": _MTIMES_DENSE, "casadi_mtimes": _MTIMES}


class CKernel(Protocol):
    """C that computes a whole CasADi function in place of its generated body."""

    @property
    def name(self) -> str:
        """Name of the CasADi function that it stands for."""

    def c_source(self, symbol: str, real: Real) -> str:
        """Definitions, all `static`, ending with `static int symbol(const casadi_real** arg, casadi_real** res,
        casadi_int* iw, casadi_real* w, int mem)`. It may use casadi_real and casadi_int, <math.h> and <stdint.h>."""


@dataclass(frozen=True, kw_only=True)
class Port:
    """One argument or result: its name and its sparsity, compressed columns as CasADi and scipy.sparse.csc have them."""

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

    The sizes are those of the arrays arg, res (pointers), iw (integers) and w (reals) that the caller owns. `mem` is 0.
    A null pointer in arg means zeros, one in res that the result is not wanted.
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
    functions: Sequence[Any],
    folder: Path,
    *,
    prefix: str,
    real: Real = "double",
    kernels: Sequence[CKernel] = (),
) -> CSource:
    """Write `<prefix>.c` and `<prefix>.h` into `folder`; every CasADi function f is exported as `<prefix>_f`.

    `kernels` replace the functions of their name, exported or called by an exported one; those that do not occur are
    ignored.
    Integers are CasADi's `long long int` with double (casadi.external loads the library) and `int` with float.
    Raises `ModelError` for a prefix that is no C identifier, for names given twice, and for functions that need stdio or
    malloc (solvers).
    """
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", prefix):
        raise ModelError("the prefix is not a C identifier", got=repr(prefix), fix="letters, digits and underscores")
    names = [f.name() for f in functions]
    double = sorted({n for n in names if names.count(n) > 1})
    if double:
        raise ModelError(f"functions given twice: {', '.join(double)}")
    integer = "long long int" if real == "double" else "int"
    generator = ca.CodeGenerator(
        f"{prefix}.c", {"verbose": False, "casadi_real": real, "casadi_int": integer, "with_header": False}
    )
    for f in functions:
        generator.add(f)
    text = str(generator.dump())
    text, used = _with_kernels(text, kernels, real)
    for name, body in _BETTER.items():
        if f"#define {name} " in text:
            text = _replaced(text, name, body)
    text = _pruned(_with_static_helpers(text))
    for token in _FORBIDDEN:
        if token in text:
            raise ModelError(f"generated C contains {token}", fix="export model functions, not solvers")
    if real == "float":
        text = single_precision(text)
    described = tuple(_describe(f, prefix, text) for f in functions)
    for name in names:
        text = _exported(text, name, f"{prefix}_{name}")
    text = f'#include "{prefix}.h"\n\n{text.strip()}\n'
    source, header = Path(folder) / f"{prefix}.c", Path(folder) / f"{prefix}.h"
    source.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(source, text.encode())
    write_atomic(header, _header(prefix, real, integer, described).encode())
    return CSource(
        source=source, header=header, prefix=prefix, real=real, integer=integer, functions=described, kernels=used
    )


def single_precision(text: str) -> str:
    """C text with every floating literal and every libm call in its float form; comments and strings stay.

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


# ------------------------------------------------------------------------------------------------ surgery by name


def _definition(text: str, name: str) -> tuple[int, int]:
    """Where the definition of function `name` starts and ends. Raises `ModelError` unless there is exactly one."""
    heads = list(re.finditer(rf"^[a-z][\w \*]*?\b{name}\s*\([^;{{}}]*\)\s*\{{", text, re.MULTILINE))
    if len(heads) != 1:
        raise ModelError(
            f"generated C defines {name} {len(heads)} times", expected="once", fix="report the CasADi version"
        )
    start, depth, at = heads[0].start(), 1, heads[0].end()
    for brace in re.finditer(r"[{}]", text[at:]):
        depth += 1 if brace[0] == "{" else -1
        if depth == 0:
            end = at + brace.end()
            return start, end + 1 if text[end : end + 1] == "\n" else end
    raise ModelError(f"generated C does not end {name}", fix="report the CasADi version")


def _replaced(text: str, name: str, body: str) -> str:
    start, end = _definition(text, name)
    return text[:start] + body + text[end:]


def _with_kernels(text: str, kernels: Sequence[CKernel], real: Real) -> tuple[str, tuple[str, ...]]:
    used = []
    for kernel in kernels:
        found = re.findall(rf"^/\* {re.escape(kernel.name)}:\(.*\) \*/\nstatic int (casadi_f\d+)\(", text, re.MULTILINE)
        if len(found) > 1:
            raise ModelError(f"{len(found)} different functions are named {kernel.name}", expected="one")
        if found:
            text = _replaced(text, found[0], kernel.c_source(found[0], real))
            used.append(kernel.name)
    return text, tuple(used)


def _with_static_helpers(text: str) -> str:
    return re.sub(r"^((?:void|int|casadi_real|casadi_int) casadi_\w+\()", r"static \1", text, flags=re.MULTILINE)


def _pruned(text: str) -> str:
    """Without static constants and helpers that are mentioned only where they are defined."""
    while True:
        body = re.sub(r"^#define casadi_.*$", "", text, flags=re.MULTILINE)
        count = Counter(re.findall(r"\bcasadi_\w+", body))
        constants = re.findall(r"^static const casadi_(?:real|int) (casadi_\w+)\[", body, re.MULTILINE)
        helpers = re.findall(r"^static (?:void|int|casadi_real|casadi_int) (casadi_\w+)\(", body, re.MULTILINE)
        idle = {n for n in (*constants, *helpers) if count[n] == 1}
        if not idle:
            return text
        for name in idle & set(helpers):
            text = _replaced(text, name, "")
        for name in idle:
            text = re.sub(rf"^static const casadi_(?:real|int) {name}\[[^;]*;\n", "", text, flags=re.MULTILINE)
            text = re.sub(rf"^#define {name} .*\n", "", text, flags=re.MULTILINE)


def _exported(text: str, name: str, symbol: str) -> str:
    """With the exported functions of `name` renamed to those of `symbol`."""
    pattern = rf"^(CASADI_SYMBOL_EXPORT [\w \*]+?\b){re.escape(name)}((?:_(?:{_SUFFIXES}))?\()"
    changed, n = re.subn(pattern, rf"\g<1>{symbol}\g<2>", text, flags=re.MULTILINE)
    if n == 0:
        raise ModelError(f"generated C does not export {name}", fix="report the CasADi version")
    return changed


# ------------------------------------------------------------------------------------------------ description


def _port(name: str, sparsity: Any) -> Port:
    return Port(
        name=name, rows=sparsity.size1(), columns=sparsity.size2(),
        colind=tuple(sparsity.colind()), row=tuple(sparsity.row()),
    )  # fmt: skip


def _describe(f: Any, prefix: str, text: str) -> CFunction:
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
    match = re.search(rf"^CASADI_SYMBOL_EXPORT int {re.escape(name)}_work\(.*?^}}", text, re.MULTILINE | re.DOTALL)
    if match is None:
        raise ModelError(f"generated C states no work sizes of {name}", fix="report the CasADi version")
    return match.span()


def _shape(port: Port) -> str:
    size = f"{port.rows}" if port.columns == 1 else f"{port.rows} x {port.columns}"
    return f"{port.name}[{size}]" if port.dense else f"{port.name}[{size}, {port.nnz} stored]"


def _header(prefix: str, real: Real, integer: str, functions: Sequence[CFunction]) -> str:
    guard = f"{prefix.upper()}_H"
    lines = [
        f"/* {prefix}: functions generated by greybox with CasADi {ca.CasadiMeta.version()}, in {real}.",
        "   Every function: arg, res are arrays of pointers, iw and w work space, all owned by the caller, with the sizes",
        "   below; mem is 0; the return value is 0 unless the evaluation failed. A null pointer in arg means zeros, one in",
        "   res that the result is not wanted. Matrices are stored column by column. Reentrant: no static variables. */",
        f"#ifndef {guard}", f"#define {guard}", "", "#ifdef __cplusplus", 'extern "C" {', "#endif", "",
        f"typedef {real} {prefix}_real;", f"typedef {integer} {prefix}_int;",
    ]  # fmt: skip
    for f in functions:
        upper = f.symbol.upper()
        lines += ["", f"/* {f.name}({', '.join(map(_shape, f.inputs))}) -> {', '.join(map(_shape, f.outputs))} */"]
        lines += [f"#define {upper}_{k.upper()} {getattr(f, k)}" for k in ("sz_arg", "sz_res", "sz_iw", "sz_w")]
        lines += [
            f"int {f.symbol}(const {prefix}_real** arg, {prefix}_real** res, {prefix}_int* iw, {prefix}_real* w, int mem);"
        ]
    lines += ["", "#ifdef __cplusplus", "}", "#endif", "", f"#endif /* {guard} */", ""]
    return "\n".join(lines)
