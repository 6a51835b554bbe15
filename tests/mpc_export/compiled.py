"""C of exported functions for the tests: strict flags, sanitizers, and calls through ctypes."""

from __future__ import annotations

import ctypes
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
        pytest.skip("C compiler is not installed")


def compile_objects(
    bundle: ExportBundle, work: Path, compiler: str = "gcc", *flags: str
) -> list[str]:
    """The library's two units, each under the strict flags that the bundle promises."""
    needs_compiler()
    name, objects = bundle.name, []
    work.mkdir(parents=True, exist_ok=True)
    for stem in (name, f"{name}_model"):
        objects.append(str(work / f"{stem}.o"))
        source = str(bundle.folder / "c" / f"{stem}.c")
        done = subprocess.run(
            [
                compiler,
                *STRICT,
                *(flags or ("-O1",)),
                "-fPIC",
                "-c",
                source,
                "-o",
                objects[-1],
            ],
            capture_output=True,
            text=True,
            check=False,
        )
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


def largest_difference(
    bundle: ExportBundle, library: CLibrary, functions, points
) -> dict[str, float]:
    """Function -> largest difference between C and CasADi over `points`, in units of each output's
    scale.

    Every entry of a vector is a signal of its own scale (a torque beside a position), every matrix
    has one scale.
    """
    worst: dict[str, float] = {}
    for entry in bundle.manifest["functions"]:
        made = functions[entry["name"]]
        given = [np.zeros(max(made.numel_in(i), 1)) for i in range(made.n_in())]
        ours, theirs = (
            [np.zeros(max(made.numel_out(i), 1)) for i in range(made.n_out())] for _ in range(2)
        )
        run_c = _c_call(library, entry, given, ours)
        buffer, run_casadi = made.buffer()
        for i, a in enumerate(given):
            buffer.set_arg(i, a.data)
        for i, a in enumerate(theirs):
            buffer.set_res(i, a.data)
        whole = [port["columns"] > 1 for port in entry["results"]]
        gap = [np.zeros(1 if one else b.size) for one, b in zip(whole, theirs, strict=True)]
        size = [np.full(g.size, 1e-30) for g in gap]
        for point in points:
            for i, name in enumerate(made.name_in()):
                n = made.numel_in(i)
                given[i][:n] = np.ravel(point[name], order="F")[:n]
            assert run_c() == 0
            run_casadi()
            for k, (a, b) in enumerate(zip(ours, theirs, strict=True)):
                assert np.isfinite(b).all(), entry["name"]
                apart, large = np.abs(a - b), np.abs(b)
                gap[k] = np.maximum(gap[k], apart.max() if whole[k] else apart)
                size[k] = np.maximum(size[k], large.max() if whole[k] else large)
        # What stays below a millionth of its neighbours is rounding.
        worst[entry["name"]] = max(
            float((g / np.maximum(s, 1e-6 * s.max())).max()) for g, s in zip(gap, size)
        )
    return worst


def _c_call(library: CLibrary, entry, given, results):
    """A function of nothing that calls the C function on these arrays."""
    sizes, pointer = (
        library.manifest["c"]["functions"][entry["name"]],
        ctypes.POINTER(ctypes.c_double),
    )
    assert library.real is ctypes.c_double
    arg = (pointer * max(sizes["sz_arg"], 1))(*(a.ctypes.data_as(pointer) for a in given))
    res = (pointer * max(sizes["sz_res"], 1))(*(a.ctypes.data_as(pointer) for a in results))
    iw, w = (
        (library.integer * max(sizes["sz_iw"], 1))(),
        (ctypes.c_double * max(sizes["sz_w"], 1))(),
    )
    function = getattr(library.library, f"{library.manifest['name']}_{entry['name']}")
    return lambda: function(arg, res, iw, w, 0)


def manifest_schema() -> dict:
    from importlib import resources

    return dict(
        json.loads(resources.files("greybox.schemas").joinpath("manifest.json").read_text())
    )
