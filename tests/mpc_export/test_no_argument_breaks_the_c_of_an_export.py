"""No argument, however wild, makes exported C leave its memory, do what C does not define, hang, or
remember.

GREYBOX_FUZZ=1000000 python -m pytest -m slow THIS_FILE -s   # a million calls each, double and float
"""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

from mpc_export.bundle import ExportBundle, write_bundle
from mpc_export.golden import golden_vectors
from tests.mpc_export import cases, compiled

FUZZ = [Path(__file__).parent / name for name in ("fuzz_random.c", "fuzz_functions.c")]
MANY = int(os.environ.get("GREYBOX_FUZZ", "20000"))
SANITIZED = ("-O1", "-fsanitize=address,undefined,float-cast-overflow", "-fno-sanitize-recover=all")
MODELS = {"hybrid": cases.hybrid, "linear": cases.linear}


def table(bundle: ExportBundle) -> str:
    """The functions of a bundle as the C that fuzz_functions.c stands behind."""
    real, integer = bundle.manifest["c"]["real"], bundle.manifest["c"]["integer"]
    golden = {g.name: g for g in golden_vectors(bundle.functions, 2)}
    texts = [
        f"typedef {real} real;\ntypedef {integer} integer;",
        "typedef int (*called_as)(const real **, real **, integer *, real *, int);",
        "typedef struct { const char *name; called_as call; int n_arg, n_res, sz_arg, sz_res, "
        "sz_iw, sz_w;"
        " const int *arg, *res; const real *nominal; } function;",
    ]
    rows = []
    for k, entry in enumerate(bundle.manifest["functions"]):
        name, sizes, g = (
            entry["name"],
            bundle.manifest["c"]["functions"][entry["name"]],
            golden[entry["name"]],
        )
        values = np.concatenate([v[1] for v in g.arguments.values()])
        given = [v.shape[1] for v in g.arguments.values()]
        got = [p["rows"] * p["columns"] for p in entry["results"]]
        symbol = f"{bundle.name}_{name}"
        texts.append(
            f"int {symbol}(const real **, real **, integer *, real *, int);\n"
            f"static const int arg_{k}[] = {{{', '.join(map(str, [*given, 0]))}}}, "
            f"res_{k}[] = {{{', '.join(map(str, [*got, 0]))}}};\n"
            f"static const real nominal_{k}[] = "
            f"{{{', '.join(f'(real){v!r}' for v in [*values.tolist(), 0.0])}}};"
        )
        numbers = ", ".join(str(sizes[s]) for s in ("sz_arg", "sz_res", "sz_iw", "sz_w"))
        rows.append(
            f'{{"{name}", {symbol}, {len(given)}, {len(got)}, {numbers}, arg_{k}, res_{k}, '
            f"nominal_{k}}}"
        )
    texts.append(
        f"enum {{ COUNT = {len(rows)} }};\nstatic const function FUNCTIONS[COUNT] = "
        f"{{{', '.join(rows)}}};"
    )
    return "\n".join(texts) + "\n"


def program(folder: Path, model: str, real: str, flags: tuple[str, ...]) -> str:
    """The fuzz of a model's bundle, compiled."""
    compiled.needs_compiler()
    more = {"hybrid": ("filter", "covariance")}.get(model, ("filter",))
    bundle = write_bundle(
        MODELS[model](), folder / "b", targets=("c",), real=real, with_=more, use_cache=False
    )
    source = folder / "fuzz.c"
    source.write_text(table(bundle) + "".join(f.read_text() for f in FUZZ))
    out = str(folder / "fuzz")
    made = [
        compiled.COMPILERS[0],
        "-std=c99",
        *flags,
        "-w",
        str(source),
        str(bundle.folder / "c" / f"{bundle.name}.c"),
    ]
    done = subprocess.run([*made, "-o", out, "-lm"], capture_output=True, text=True, check=False)
    if done.returncode and "sanitize" in done.stderr:
        pytest.skip("no sanitizers")
    assert done.returncode == 0, done.stderr[:2000]
    return out


def judged(command: str, steps: int, seed: int) -> None:
    done = subprocess.run(
        [command, str(steps), str(seed)], capture_output=True, text=True, check=False, timeout=1800
    )  # a hang ends in TimeoutExpired
    print(done.stdout)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    rows = [line.split() for line in done.stdout.splitlines()]
    counts = {name: [int(n) for n in numbers] for name, *numbers in rows}
    assert len(counts) == 10
    assert sum(row[0] for row in counts.values()) == steps
    # it was hostile, and it was judged
    assert counts["nan"][2] > 0 < counts["nominal"][1] == counts["nominal"][0]


@pytest.mark.parametrize("real", ["double", "float"])
def test_a_linear_model_under_sanitizers(tmp_path, real):
    judged(program(tmp_path, "linear", real, SANITIZED), 2000, 1)


@pytest.mark.slow
@pytest.mark.parametrize("real", ["double", "float"])
@pytest.mark.parametrize("model", MODELS)
def test_many_calls_stay_inside_their_memory(tmp_path, model, real):
    judged(program(tmp_path, model, real, SANITIZED), min(MANY, 20000), 2)


@pytest.mark.slow
@pytest.mark.parametrize("real", ["double", "float"])
@pytest.mark.parametrize("model", MODELS)
def test_many_calls_remember_nothing(tmp_path, model, real):
    judged(program(tmp_path, model, real, ("-O2",)), MANY, 3)
