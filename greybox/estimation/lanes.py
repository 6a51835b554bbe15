"""Generated straight-line C, rewritten to run several samples at once.

Once the states of a record are known, its linearisations do not depend on each other: four samples share one pass, one in
each lane of a vector register (GNU C vector extensions, which gcc and clang lower to what the processor has). Sums,
products and quotients act on whole vectors; the few functions, comparisons and branches run lane by lane. The numbers
are those of the scalar code up to rounding.
"""

from __future__ import annotations

import re

LANES = 4
FLAGS = ("-O1", "-ffp-contract=off", "-march=native", "-fPIC", "-w")
QUICK_FLAGS = ("-O0", *FLAGS[1:])
"""Without optimisation, the same sums and products in the same order: nothing is fused in either."""
PRELUDE = f"""/* lanes, revision 1 */
typedef double gb_lanes __attribute__((vector_size({8 * LANES})));
typedef double gb_lanes_store __attribute__((vector_size({8 * LANES}), aligned(8), may_alias));
#define GB_LOAD(i, j) ((gb_lanes){{{", ".join(f"arg[(i) * {LANES} + {k}][j]" for k in range(LANES))}}})
#define GB_STORE(i, j, v) (*(gb_lanes_store *)(res[i] + {LANES} * (j)) = (v))
#define GB_ALL(v) ((gb_lanes){{{", ".join(["v"] * LANES)}}})
"""
"""Goes before the text to rewrite. Raise the revision when the rewriting changes: libraries are cached by this text."""

_BODY = re.compile(r"(static int casadi_f\d+\([^{]*\{\n)(.*?)(\n  return 0;\n\}\n)", re.DOTALL)
_LOAD = re.compile(r"(a\d+)=arg\[(\d+)\]\? arg\[\d+\]\[(\d+)\] : 0;")
_STORE = re.compile(r"if \(res\[(\d+)\]!=0\) res\[\d+\]\[(\d+)\]=(a\d+);")
_ASSIGN = re.compile(r"(a\d+)=(.*);")
_SQUARE = re.compile(r"casadi_sq\((a\d+)\)")
_ARITHMETIC = re.compile(r"[-+*/()0-9.ea]*")
_VARIABLE = re.compile(r"\b(a\d+)\b")


def rewrite(text: str) -> str:
    """The C text with the body of every generated function turned to lanes.

    A function then takes LANES pointers per argument and stores entry j of an output in places LANES j, LANES j + 1, ...
    """
    return _BODY.sub(lambda m: m[1] + "\n".join(_line(row) for row in m[2].split("\n")) + m[3], text)


def _line(row: str) -> str:
    code = row.strip()
    if code.startswith("casadi_real "):
        return "  gb_lanes " + code.removeprefix("casadi_real ")
    if found := _LOAD.fullmatch(code):
        return f"  {found[1]}=GB_LOAD({found[2]},{found[3]});"
    if found := _STORE.fullmatch(code):
        return f"  GB_STORE({found[1]},{found[2]},{found[3]});"
    found = _ASSIGN.fullmatch(code)
    if not found:
        if code:
            raise ValueError(f"a line of generated code that cannot run in lanes: {code[:80]}")
        return row
    value = _SQUARE.sub(r"(\1*\1)", found[2])
    if not _VARIABLE.search(value):
        return f"  {found[1]}=GB_ALL({value});"
    if _ARITHMETIC.fullmatch(value):
        return f"  {found[1]}={value};"
    each = _VARIABLE.sub(r"\1[l]", value)
    return f"  for (int l=0; l<{LANES}; ++l) {found[1]}[l]={each};"
