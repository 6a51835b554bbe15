"""acados brings an HPIPM of another layout: plans are the same with it in the process."""

import ctypes
import os
import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = """
import ctypes, sys
if sys.argv[1] != "-":
    for name in ("blasfeo", "hpipm"):
        ctypes.CDLL(f"{sys.argv[1]}/lib{name}.so", mode=ctypes.RTLD_GLOBAL)
from tests.mpc_export.tube.test_tube_solver_agrees_with_ipopt import pair, pose
solver, _ = pair()
data = pose(solver, 0.08)
assert solver.solve().status == 0
print(data["u"].tolist())
"""


def plan(libraries: str) -> str:
    root = Path(__file__).resolve().parents[3]
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, libraries],
        capture_output=True,
        text=True,
        check=True,
        cwd=root,
        timeout=300,
    )
    return done.stdout


@pytest.mark.skipif("GREYBOX_ACADOS" not in os.environ, reason="acados is not installed")
def test_plans_do_not_change_beside_acados():
    libraries = Path(os.environ["GREYBOX_ACADOS"]) / "acados" / "install" / "lib"
    assert ctypes.CDLL(str(libraries / "libblasfeo.so"))
    assert plan(str(libraries)) == plan("-")
