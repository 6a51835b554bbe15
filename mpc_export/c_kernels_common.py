"""C that the Gaussian-process kernels share: vectors of reals, an exponential that runs on them, a
triangular product.

Plain C99. Where the compiler has vectors (GNU C: gcc and clang) the same text works on as many
reals as the target's registers hold, elsewhere (Cortex-M4F) on single ones. Arrays are padded to
`PAD` reals, so that no loop has a rest. The exponential takes arguments <= 0, keeps NaN, and is 0
below -708 (-87 in float): Cody and Waite's reduction, x = n ln 2 + r, and a polynomial in r on [-ln
2/2, ln 2/2] (interpolation in Chebyshev nodes, relative error 1.7e-17, in float 1e-8). In float it
is exp(x) - 1, whose digits are not lost where covariances are all near one.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from greybox.symbolic import FloatArray

PAD = {"double": 8, "float": 4}
"""Reals to which arrays are padded, and rows of a block of the triangular product."""

_COEFFICIENTS = {
    "double": (
        1.0,
        1.0,
        0.5000000000000001,
        0.16666666666666669,
        0.04166666666662413,
        0.008333333333330062,
        0.0013888888917213717,
        0.00019841269863053618,
        2.4801521295954376e-05,
        2.7557268459997064e-06,
        2.7620088445409746e-07,
        2.510038549551032e-08,
    ),
    "float": (
        1.0,
        1.0,
        0.5,
        0.16666576666119928,
        0.04166655421298415,
        0.008363232883682618,
        0.0013926250831497611,
    ),
}

_VECTORS = """\
/* Vectors of GB_LANES reals where the compiler has them, single reals elsewhere. Casts between them keep the bits. */
#include <stdint.h>
typedef @bits@ gb_bits;
#if defined(__GNUC__) && defined(__AVX512F__) && @pad@*@size@ >= 64
#define GB_BYTES 64
#elif defined(__GNUC__) && defined(__AVX__) && @pad@*@size@ >= 32
#define GB_BYTES 32
#elif defined(__GNUC__) && (defined(__SSE2__) || defined(__aarch64__))
#define GB_BYTES 16
#endif
#ifdef GB_BYTES
#define GB_LANES (GB_BYTES/@size@)
#define GB_ALIGNED __attribute__((aligned(64)))
typedef casadi_real gb_v __attribute__((vector_size(GB_BYTES)));
typedef casadi_real gb_loose __attribute__((vector_size(GB_BYTES), aligned(@size@), may_alias));
typedef gb_bits gb_i __attribute__((vector_size(GB_BYTES)));
#define GB_LOAD(p) (*(const gb_loose*)(p))
#define GB_STORE(p, v) (*(gb_loose*)(p) = (v))
#else
#define GB_LANES 1
#define GB_ALIGNED
typedef casadi_real gb_v;
#define GB_LOAD(p) (*(p))
#define GB_STORE(p, v) (*(p) = (v))
#endif
"""

_EXP = """\
/* @what@ for x <= 0, lane by lane. */
static inline gb_v @name@(gb_v x) {
#if GB_LANES > 1
  const gb_v t = x*@log2e@ + @magic@, n = t - @magic@;
#else
  union { casadi_real real; gb_bits bits; } t, s;
  gb_v n;
#endif
  gb_v r, y;
#if GB_LANES == 1
  t.real = x*@log2e@ + @magic@;
  n = t.real - @magic@;
#endif
  r = (x - n*@high@) - n*@low@;
@polynomial@
#if GB_LANES > 1
  {
    const gb_v s = (gb_v)(((gb_i)t << @shift@) + ((gb_bits)@bias@ << @shift@));
    const gb_i least = (gb_i)(x < @least@);
    @vector@
  }
#else
  s.bits = (t.bits << @shift@) + ((gb_bits)@bias@ << @shift@);
  @scalar@
#endif
}
"""

_SUM = """\
static inline casadi_real gb_sum(gb_v a) {
#if GB_LANES == 8
  return ((a[0]+a[4]) + (a[2]+a[6])) + ((a[1]+a[5]) + (a[3]+a[7]));
#elif GB_LANES == 4
  return (a[0]+a[2]) + (a[1]+a[3]);
#elif GB_LANES == 2
  return a[0]+a[1];
#else
  return a;
#endif
}
"""


def exponential(real: str) -> str:
    """Definition of `gb_exp`, exp(x); in float of `gb_expm1`, exp(x) - 1."""
    double = real == "double"
    polynomial = _estrin(_COEFFICIENTS[real][0 if double else 1 :])
    parts = {
        "what": "exp(x)" if double else "exp(x) - 1",
        "name": "gb_exp" if double else "gb_expm1",
        "log2e": "1.4426950408889634" if double else "1.44269504",
        "magic": "6755399441055744.0" if double else "12582912.0",
        "high": "6.93147180369123816490e-01" if double else "0.693145751953125",
        "low": "1.90821492927058770002e-10" if double else "1.42860677e-06",
        "shift": "52" if double else "23",
        "bias": "1023" if double else "127",
        "least": "-708.0" if double else "-87.0",
        "polynomial": polynomial if double else f"{polynomial}\n  y *= r;",
        # NaN is not below the least argument and stays.
        "vector": "return (gb_v)((gb_i)(y*s) & ~least);"
        if double
        else "y = y*s + (s - 1.0);\n    return (gb_v)((gb_i)y & ~least) - (gb_v)(least & "
        "(gb_bits)0x3f800000);",
        "scalar": "return x < -708.0 ? 0 : y*s.real;"
        if double
        else "return x < -87.0 ? -1 : y*s.real + (s.real - 1.0);",
    }
    return _filled(_EXP, parts)


def _estrin(coefficients: Sequence[float]) -> str:
    """y = sum_i c_i r^i in Estrin's scheme: half the depth of Horner's."""
    level = [_number(v) for v in coefficients]
    lines: list[str] = []
    power, step = "r", 0
    while len(level) > 1:
        merged = []
        for i in range(0, len(level) - 1, 2):
            merged.append(f"p{step}_{i // 2}")
            lines.append(f"    const gb_v {merged[-1]} = {level[i]} + {power}*{level[i + 1]};")
        if len(level) % 2:
            merged.append(level[-1])
        level = merged
        if len(level) > 1:
            lines.append(f"    const gb_v r{step} = {power}*{power};")
            power = f"r{step}"
        step += 1
    return "  {\n" + "\n".join(lines) + f"\n    y = {level[0]};\n  }}"


def vectors(real: str) -> str:
    """The types and macros that everything else stands on."""
    parts = {
        "bits": "uint64_t" if real == "double" else "uint32_t",
        "size": "8" if real == "double" else "4",
        "pad": str(PAD[real]),
    }
    return _filled(_VECTORS, parts)


def lane_sum() -> str:
    """Definition of `gb_sum`, the sum over the lanes of a vector."""
    return _SUM


def triangular_product(real: str, *, back: bool) -> str:
    """Definition of `gb_norm(e, k, n)`, |E k|^2, or with `back` of `gb_norm_back(e, k, v, n)`,
    which also gives v = E'E k.

    e holds a lower triangular E as `blocks` lays it out, k and v have n reals. Each block of rows
    is read once. In float k comes without a constant, whose product with E is the last argument: |E
    k + start|^2.
    """
    rows = range(PAD[real])
    name = "gb_norm_back" if back else "gb_norm"
    start = real == "float"
    out = [
        f"static casadi_real {name}(const casadi_real* restrict e, const casadi_real* restrict k,",
        f"    {'casadi_real* restrict v, ' if back else ''}int "
        f"n{', const casadi_real* start' if start else ''}) {{",
        "  casadi_real s = 0;",
        "  int g, c, m;",
        f"  for (g=0; g<n; g+={len(rows)}) {{",
        f"    gb_v {', '.join(f'a{r} = {{0}}' for r in rows)};",
        f"    m = g + {len(rows)};",
        "    for (c=0; c<m; c+=GB_LANES) {",
        "      const gb_v x = GB_LOAD(k + c);",
        *(f"      a{r} += GB_LOAD(e + {r}*m + c)*x;" for r in rows),
        "    }",
        "    {",
        *(
            f"      const casadi_real s{r} = gb_sum(a{r}){f' + start[g + {r}]' if start else ''};"
            for r in rows
        ),
        f"      s += {tree([f's{r}*s{r}' for r in rows])};",
    ]
    if back:
        term = tree([f"GB_LOAD(e + {r}*m + c)*s{r}" for r in rows])
        out += [
            f"      for (c=0; c<g; c+=GB_LANES) GB_STORE(v + c, GB_LOAD(v + c) + ({term}));",
            f"      for (; c<m; c+=GB_LANES) GB_STORE(v + c, {term});",
        ]
    out += ["    }", f"    e += {len(rows)}*m;", "  }", "  return s;", "}", ""]
    return "\n".join(out)


def blocks(factor: FloatArray, real: str) -> FloatArray:
    """A lower triangular (M, M) as `triangular_product` reads it: `PAD` rows at a time, each as
    long as the block needs."""
    pad = PAD[real]
    n = padded(len(factor), real)
    full = np.zeros((n, n))
    full[: len(factor), : len(factor)] = np.tril(factor)
    return np.concatenate([full[g : g + pad, : g + pad].ravel() for g in range(0, n, pad)])


def padded(n: int, real: str) -> int:
    """n rounded up to a multiple of `PAD`."""
    return -(-n // PAD[real]) * PAD[real]


def constants(name: str, values: FloatArray | Sequence[float], real: str) -> str:
    """Definition of a constant array."""
    flat = np.asarray(values, dtype=np.float64).ravel()
    numbers = [_number(v) for v in (flat if real == "double" else flat.astype(np.float32))]
    rows = [", ".join(numbers[i : i + 8]) for i in range(0, len(numbers), 8)]
    return (
        f"static const casadi_real {name}[{len(numbers)}] GB_ALIGNED = {{\n  "
        + ",\n  ".join(rows)
        + "};\n"
    )


def _number(value: float | np.floating) -> str:
    text = repr(float(value)) if not isinstance(value, np.float32) else str(value)
    return text if any(c in text for c in ".en") else f"{text}.0"


def tree(terms: Sequence[str]) -> str:
    """A sum in pairs, so that it does not wait for itself."""
    level = list(terms)
    while len(level) > 1:
        level = [f"({a} + {b})" for a, b in zip(level[::2], level[1::2])] + level[len(level) & ~1 :]
    return level[0]


def _filled(template: str, parts: dict[str, str]) -> str:
    for key, value in parts.items():
        template = template.replace(f"@{key}@", value)
    return template
