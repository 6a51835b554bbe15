"""SIGINT to a long command in a process of its own: exit code 130, one line, no half-written file.

Interrupts inside `discover` and `mpc`, and what they keep: tests/cli/test_discover_writes_what_it_finds.py and
tests/cli/test_mpc_flies_resumes_and_refuses.py.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from scenarios.flights import flight_path, vehicle_path
from tests.hardening.log_faults import SET

FLIGHTS = [str(flight_path(SET, n)) for n in ("B8_star_fast_rep2", "B8_star_fast_rep3", "B8_star_medium_rep1")]
FIT = ["--vehicle", str(vehicle_path(SET)), "--train", *FLIGHTS]
COMMANDS = {
    "fit": ["fit", *FIT, "--effects", "motor_lag,rotor_drag,command_delay"],
    "discover": ["discover", *FIT],
    "plan": ["plan", "--vehicle", str(vehicle_path(SET))],
}


@pytest.mark.parametrize(("command", "after"), [("fit", 5.0), ("discover", 5.0), ("plan", 4.0)])
def test_an_interrupt_is_one_line_and_leaves_whole_files(command: str, after: float, tmp_path: Path) -> None:
    out = tmp_path / "out"
    process = subprocess.Popen(
        [sys.executable, "-m", "greybox.cli", *COMMANDS[command], "--out", str(out)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path,
    )  # fmt: skip
    try:
        time.sleep(after)
        if process.poll() is not None:
            pytest.skip("done before it was interrupted")
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 130, said
    assert "Traceback" not in said
    assert said.strip().splitlines()[-1] == f"greybox {command}: interrupted"
    files = [p for p in tmp_path.rglob("*") if p.is_file()]
    assert not [p for p in files if p.suffix == ".part"]
    for path in files:
        if path.suffix == ".json":
            json.loads(path.read_text())
