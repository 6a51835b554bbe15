"""C of exported functions for the tests: strict flags, sanitizers, and calls through ctypes."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from mpc_export.bundle import ExportBundle
from mpc_export.verify import STRICT, CLibrary

COMPILERS = [c for c in ("gcc", "clang") if shutil.which(c)]


def needs_compiler() -> None:
    if not COMPILERS:
        pytest.skip("no C compiler")


def compile_objects(bundle: ExportBundle, work: Path, compiler: str = "gcc", *flags: str) -> list[str]:
    """The library's two units, each under the strict flags that the bundle promises."""
    needs_compiler()
    name, objects = bundle.name, []
    work.mkdir(parents=True, exist_ok=True)
    for stem, extra in ((name, ["-Wno-unused-parameter"]), (f"{name}_model", [])):
        objects.append(str(work / f"{stem}.o"))
        source = str(bundle.folder / "c" / f"{stem}.c")
        done = subprocess.run(
            [compiler, *STRICT, *extra, *(flags or ("-O1",)), "-fPIC", "-c", source, "-o", objects[-1]],
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr[:2000]
    return objects


def link(objects: list[str], work: Path) -> Path:
    """Shared library of compiled units."""
    work.mkdir(parents=True, exist_ok=True)
    subprocess.run(["gcc", "-shared", *objects, "-o", work / "model.so", "-lm"], check=True)
    return work / "model.so"


def compile_library(bundle: ExportBundle, work: Path, compiler: str = "gcc", *flags: str) -> Path:
    """Both."""
    return link(compile_objects(bundle, work, compiler, *flags), work)


def load(bundle: ExportBundle, library: Path) -> CLibrary:
    return CLibrary(library, bundle.manifest)


def largest_difference(bundle: ExportBundle, library: CLibrary, functions, points) -> dict[str, float]:
    """Function -> largest difference between C and CasADi over `points`, in units of each output's scale."""
    worst: dict[str, float] = {}
    for entry in bundle.manifest["functions"]:
        made = functions[entry["name"]]
        got, want = [], []
        for point in points:
            given = [np.ravel(point[n], order="F")[: made.numel_in(i)] for i, n in enumerate(made.name_in())]
            got.append(library.call(entry, [g.tolist() for g in given]))
            shaped = [np.reshape(g, made.size_in(i), order="F") for i, g in enumerate(given)]
            want.append([v.full().ravel(order="F") for v in made.call([np.asarray(s) for s in shaped])])
        for k in range(made.n_out()):
            ours, theirs = (np.array([row[k] for row in rows]) for rows in (got, want))
            if theirs.size:
                assert np.isfinite(theirs).all(), entry["name"]
                scale = max(float(np.abs(theirs).max()), 1e-30)
                gap = float(np.abs(ours - theirs).max()) / scale
                worst[entry["name"]] = max(worst.get(entry["name"], 0.0), gap)
    return worst


def manifest_schema() -> dict:
    from importlib import resources

    return dict(json.loads(resources.files("greybox.schemas").joinpath("manifest.json").read_text()))
