"""The README and the licences of a bundle, from its manifest."""

from __future__ import annotations

import re
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Literal

from greybox.errors import printable
from mpc_export.c_model import WORTH
from mpc_export.manifest import Column, CPart, Manifest, PortRow, SignalRow

LISTED = 60

CASADI_NOTICE = """\
The generated functions were written by CasADi (https://casadi.org). CasADi's authors make no ownership claim of generated
code; the small helper functions named casadi_... that it copies into the file come from casadi/core/runtime and are under
the MIT No Attribution license (MIT-0, https://github.com/casadi/casadi/issues/3015):

Permission is hereby granted, free of charge, to any person obtaining a copy of this software and associated documentation
files (the "Software"), to deal in the Software without restriction, including without limitation the rights to use, copy,
modify, merge, publish, distribute, sublicense, and/or sell copies of the Software, and to permit persons to whom the
Software is furnished to do so.

THE SOFTWARE IS PROVIDED "AS IS", WITHOUT WARRANTY OF ANY KIND, EXPRESS OR IMPLIED, INCLUDING BUT NOT LIMITED TO THE
WARRANTIES OF MERCHANTABILITY, FITNESS FOR A PARTICULAR PURPOSE AND NONINFRINGEMENT. IN NO EVENT SHALL THE AUTHORS OR
COPYRIGHT HOLDERS BE LIABLE FOR ANY CLAIM, DAMAGES OR OTHER LIABILITY, WHETHER IN AN ACTION OF CONTRACT, TORT OR OTHERWISE,
ARISING FROM, OUT OF OR IN CONNECTION WITH THE SOFTWARE OR THE USE OR OTHER DEALINGS IN THE SOFTWARE.
"""
MIT = """\
MIT License

Permission is hereby granted, free of charge, to any person obtaining a copy of this software and associated documentation
files (the "Software"), to deal in the Software without restriction, including without limitation the rights to use, copy,
modify, merge, publish, distribute, sublicense, and/or sell copies of the Software, and to permit persons to whom the
Software is furnished to do so, subject to the following conditions:

The above copyright notice and this permission notice shall be included in all copies or substantial portions of the
Software.

THE SOFTWARE IS PROVIDED "AS IS", WITHOUT WARRANTY OF ANY KIND, EXPRESS OR IMPLIED, INCLUDING BUT NOT LIMITED TO THE
WARRANTIES OF MERCHANTABILITY, FITNESS FOR A PARTICULAR PURPOSE AND NONINFRINGEMENT. IN NO EVENT SHALL THE AUTHORS OR
COPYRIGHT HOLDERS BE LIABLE FOR ANY CLAIM, DAMAGES OR OTHER LIABILITY, WHETHER IN AN ACTION OF CONTRACT, TORT OR OTHERWISE,
ARISING FROM, OUT OF OR IN CONNECTION WITH THE SOFTWARE OR THE USE OR OTHER DEALINGS IN THE SOFTWARE.
"""


def _copyright() -> str:
    """The copyright line of greybox's LICENSE, where the source tree is at hand."""
    path = Path(str(resources.files("greybox"))).parent / "LICENSE"
    if path.is_file():
        lines = [
            line
            for line in path.read_text(encoding="utf-8").splitlines()
            if line.startswith("Copyright")
        ]
        if lines:
            return lines[0]
    return "Copyright (c) the greybox authors"


def licences(with_c: bool) -> dict[str, str]:
    """File name -> text."""
    head, body = MIT.split("\n\n", 1)
    own = (
        "The wrapper, the self-test, the kernels of the learned part, rebuild.py, consumers and "
        f"examples come from greybox:\n\n{head}\n\n"
    )
    out = {"greybox-MIT.txt": f"{own}{_copyright()}\n\n{body}"}
    if with_c:
        out["CasADi-MIT-0.txt"] = CASADI_NOTICE
    return out


def readme(manifest: Manifest) -> str:
    """README.md: what it is, how to check it, ordering tables, functions."""
    m, n = manifest, manifest["name"]
    lines = [
        f"# {n}: {plain(m['model']['name'])}",
        "",
        f"A {m['model']['kind']} model that greybox {m['versions']['greybox']} identified, "
        f"{m['sample_time']:g} s a sample, as code. It needs nothing of greybox.",
        "",
        *(_in_c(n, m["c"]) if m["c"] else ()),
        *IN_PYTHON,
        *_targets(m),
        *_order(m),
    ]
    if len(m["frames"]) > 1:
        lines += [
            "## Frames",
            "",
            *(f"- {k.replace('_', ' ')}: {v}" for k, v in m["frames"].items()),
            "",
        ]
    lines += _functions(m)
    if m["notes"]:
        lines += [
            "## Beware",
            "",
            *(f"- {plain(note[0].upper() + note[1:])}." for note in m["notes"]),
            "",
        ]
    return "\n".join([*lines, "Licences: LICENSES/.", ""])


def _in_c(n: str, c: CPart) -> list[str]:
    return [
        "Build and run the self-test (any C99 compiler):",
        "",
        "```sh",
        f"mkdir -p build && cc -std=c99 -O2 -o build/selftest c/{n}.c c/{n}_model.c "
        f"c/{n}_selftest.c -lm",
        "build/selftest",
        "```",
        "",
        f"In C and C++ include `c/{n}_model.h`, in CMake `add_subdirectory(c)` and link `{n}`. "
        f"`c/{n}_example.cpp` is a program to start from. For speed add `-O3 -march=native "
        "-ffp-contract=fast`, never `-ffast-math`.",
        "",
        "Another export into this folder replaces files that are as they were written, and any `build/`. "
        "It stops at any that was changed or added.",
        "",
        f"Source {c['source_bytes'] / 1e3:.0f} kB, numbers in {c['real']}, work space "
        f"{c['work_bytes']} bytes per thread (on a 64-bit machine). No malloc, no stdio, no "
        "variables that live between calls.",
        "",
    ]


IN_PYTHON = (
    "In Python (casadi 3.6.7 or later, numpy):",
    "",
    "```python",
    'import sys; sys.path.insert(0, "python")',
    "import rebuild",
    'f_d = rebuild.load()["f_d"]  # casadi.Function: x_next = f_d(x, u, p)',
    "```",
    "",
    "`casadi/*.casadi`, if there, are the same functions for the CasADi version that wrote them "
    "only. `golden/*.csv` hold arguments and results of every function. `manifest.json` says all "
    "of this, and the noise of the identified filter, to programs.",
    "",
)


def _targets(m: Manifest) -> list[str]:
    lines: list[str] = []
    for target, said in m["targets_written"].items():
        if "selftest" in said:
            lines += [f"For {target}: `{said['folder']}/README.md`, `{said['selftest']}`.", ""]
            continue
        if "folder" in said:
            lines += [
                f"For {target}: `{said['folder']}/README.md`; `c/{m['name']}_bench.c` holds the "
                "predictions against a recording of outputs y and commands u that were flown.",
                "",
            ]
            continue
        lines += [f"With {target}: `python {said['example']} --help`.", ""]
        if "f_expl_difference" in said:
            worst = max(said["f_expl_difference"].items(), key=lambda pair: pair[1])
            lines += [
                f"One Runge-Kutta step of f_expl is up to {worst[1]:.1g} of a state's size "
                f"({worst[0]}) away from f_d when "
                "commands change by a tenth of their range: use discrete dynamics.",
                "",
            ]
    return lines


Vector = Literal[
    "states",
    "error_states",
    "inputs",
    "parameters",
    "outputs",
    "innovations",
    "features",
    "learned",
    "targets",
]


def _order(m: Manifest) -> list[str]:
    """What stands where in every vector."""
    lines = ["## Order", ""]
    vectors: tuple[tuple[Vector, str, tuple[Column, ...]], ...] = (
        ("states", "States x", ("scale", "reference")),
        ("error_states", "Error states (rows and columns of A, B, S, K, P)", ()),
        ("inputs", "Commands u", ("lower", "upper", "reference")),
        ("parameters", "Run-time parameters p", ("value",)),
        ("outputs", "Outputs y", ("scale",)),
        ("innovations", "Innovations e", ("sensor_noise",)),
        ("features", "Inputs z of the learned part", ()),
        ("learned", "Learned outputs", ()),
        ("targets", "Targets r", ()),
    )
    for letter, title, columns in vectors:
        if m[letter]:
            lines += _table(title, m[letter], columns)
    own = m["sizes"]["own_states"]
    if own < m["sizes"]["n_x"]:
        lines += [
            f"The first {own} states are the model's own; `f` takes these alone and knows no "
            "delay. The rest is the history of commands, `history.u.k` the command of k samples "
            f"ago. {m['delay']['form'][0].upper()}{m['delay']['form'][1:]}.",
            "",
        ]
    return lines


def _functions(m: Manifest) -> list[str]:
    lines = ["## Functions", "", "| function | arguments | results |", "|---|---|---|"]
    for f in m["functions"]:
        given, got = (", ".join(_shape(p) for p in f[k]) for k in ("arguments", "results"))
        lines.append(f"| `{f['name']}` | {given} | {got} |")
    worth = [(f["name"], WORTH[f["name"]]) for f in m["functions"] if f["name"] in WORTH]
    return [
        *lines,
        "",
        *(f"- `{name}`: {said}." for name, said in worth),
        *([""] if worth else []),
        f"Integrator: {m['integrator']}. Command: {m['hold']}.",
        "",
        "Return codes in C: "
        + "; ".join(f"{c['code']} {c['name']}, {c['meaning']}" for c in m["return_codes"])
        + ".",
        "",
        f"{m['thread_safety'][0].upper()}{m['thread_safety'][1:]}.",
        "",
    ]


def plain(text: str) -> str:
    """A name or note as itself in Markdown: on one line, no cell, link, code or HTML of its own."""
    return re.sub(r"([\\`|<>\[\]#])", r"\\\1", printable(text))


def _table(title: str, rows: Sequence[SignalRow], columns: Sequence[Column]) -> list[str]:
    lines = [
        f"{title}:",
        "",
        "| # | name | unit | "
        + "".join(f"{c.replace('_', ' ')} | " for c in columns)
        + "meaning |",
    ]
    lines.append("|" + "---|" * (4 + len(columns)))
    for row in rows[:LISTED]:
        numbers = "".join(f"{'-' if row[c] is None else format(row[c], '.6g')} | " for c in columns)
        lines.append(
            f"| {row['index']} | {plain(row['name'])} | {plain(row['unit'])} | "
            f"{numbers}{plain(row['meaning'])} |"
        )
    if len(rows) > LISTED:
        lines.append(
            f"| ... | {len(rows) - LISTED} more: manifest.json | |" + " |" * (1 + len(columns))
        )
    return [*lines, ""]


def _shape(port: PortRow) -> str:
    if port["columns"] == 1:
        return f"{port['name']}[{port['rows']}]"
    return f"{port['name']}[{port['rows']}x{port['columns']}]"
