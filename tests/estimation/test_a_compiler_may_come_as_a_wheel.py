"""Where the system has no C compiler, that of the wheel `ziglang` is called; where it has one,
never.

A stand-in for the wheel hands its arguments to the system's own compiler; the wheel itself is
tried by tests/packaging.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from greybox.estimation import build

PROGRAM = """
import ctypes
from greybox.estimation.build import MODEL_FLAGS, build, compiler, version
from mpc_export.verify import find_compiler
library = build([("f.c", "double f(double x) { return 2 * x; }", MODEL_FLAGS)])
f = ctypes.CDLL(str(library)).f
f.restype, f.argtypes = ctypes.c_double, [ctypes.c_double]
print(f(3.0), compiler()[3:5], tuple(find_compiler(None)[3:5]), bool(version(compiler())))
"""


@pytest.mark.skipif(
    shutil.which("cc") is None, reason="no C compiler to stand in for that of the wheel"
)
def test_with_an_empty_path_the_wheel_compiles(tmp_path: Path):
    stand_in = tmp_path / "wheel" / "ziglang"
    stand_in.mkdir(parents=True)
    (stand_in / "__init__.py").write_text("")
    (stand_in / "__main__.py").write_text(
        "import os, sys\nassert sys.argv.pop(1) == 'cc'\n"
        f"os.environ['PATH'] = {os.environ['PATH']!r}\n"
        f"os.execv({shutil.which('cc')!r}, ['cc', *sys.argv[1:]])\n"
    )
    root = str(Path(build.__file__).parents[2])
    environment = {
        "PATH": "",
        "PYTHONPATH": os.pathsep.join([str(tmp_path / "wheel"), root]),
        "GREYBOX_CACHE": str(tmp_path / "cache"),
    }
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout == "6.0 ('ziglang', 'cc') ('ziglang', 'cc') True\n", done.stderr


def test_a_compiler_of_the_system_comes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "cc").write_text("#!/bin/sh\n")
    (tmp_path / "cc").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    for name in ("CC", "GREYBOX_COMPILER"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(build, "from_wheel", lambda: pytest.fail("the wheel was asked"))
    assert build.compiler.__wrapped__() == (str(tmp_path / "cc"),)


def test_none_means_none(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("GREYBOX_COMPILER", "none")
    assert build.compiler.__wrapped__() is None
