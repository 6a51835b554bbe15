"""Bundles for the consumers' tests, and a way to run a bundle's own script as a stranger would."""

from __future__ import annotations

import functools
import importlib.util
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import pytest

from mpc_export.bundle import write_bundle
from tests.mpc_export import cases

ACADOS = os.environ.get("GREYBOX_ACADOS") or os.environ.get("ACADOS_SOURCE_DIR", "")
"""An installed acados, or the folder into which its wheel was unpacked: see .ci/run."""
ALONE = """
import runpy, sys

class Without:
    HIDDEN = ("greybox", "mpc_export", "scenarios", "torch", "gpytorch")
    def __init__(self, finder): self.finder = finder
    def __getattr__(self, name): return getattr(self.finder, name)
    def find_spec(self, name, *rest):
        return None if name.split(".")[0] in self.HIDDEN else self.finder.find_spec(name, *rest)

sys.meta_path[:] = [Without(finder) for finder in sys.meta_path]
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


def needs(*modules: str) -> pytest.MarkDecorator:
    """Skip, by name, where a consumer is not installed. The gate on Linux x86-64 does not accept
    that."""
    missing = [
        m for m in modules if (not ACADOS if m == "acados" else importlib.util.find_spec(m) is None)
    ]
    return pytest.mark.skipif(
        bool(missing), reason=f"consumer {', '.join(missing)} is not installed"
    )


@functools.cache
def _folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="bundles-")


@functools.cache
def bundle(kind: str) -> Path:
    """A bundle with every target: "physics" has its mass as run-time parameter, "hybrid" a learned
    part, "own" one command."""
    model = {
        "physics": cases.physics,
        "hybrid": cases.hybrid,
        "linear": cases.linear,
        "own": cases.own,
    }[kind]()
    targets = {
        "physics": ("acados", "do-mpc", "rockit", "fmu"),
        "hybrid": ("acados", "do-mpc", "rockit", "fmu", "l4acados"),
        "linear": ("do-mpc", "rockit"),
        "own": ("do-mpc", "rockit"),
    }[kind]
    place = Path(_folder().name) / kind
    runtime = ("mass",) if kind == "physics" else ()
    write_bundle(
        model,
        place,
        name=f"{kind}_model",
        targets=targets,
        runtime_parameters=runtime,
        use_cache=False,
    )
    return place


def run(kind: str, script: str, *arguments: str) -> dict[str, Any]:
    """What a bundle's script says of itself with --json, where neither greybox nor PyTorch is
    installed."""
    where = bundle(kind)
    command = [sys.executable, "-c", ALONE, str(where / "examples" / script), *arguments, "--json"]
    environment = {
        k: v
        for k, v in os.environ.items()
        if not k.startswith(("PYTHON", "ACADOS", "TERA", "LD_LIBRARY"))
    }
    done = subprocess.run(
        command, capture_output=True, text=True, cwd=where, env=environment, check=False
    )
    assert done.returncode == 0, done.stderr[-3000:]
    answer: dict[str, Any] = json.loads(done.stdout.strip().splitlines()[-1])
    return answer
