"""`greybox learn` killed (SIGKILL) before and after every file that it writes: what is there loads,
and typing the command again ends it."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from greybox.baselines.output_residual import OutputHybrid
from greybox.cli import main
from tests.cli.test_learn_takes_linear_models_too import write_log

KILLED = """
import os, signal, sys
left, after, real = int(sys.argv[1]), sys.argv[2] == "after", os.replace
def replace(*names):
    global left
    left -= 1
    if left == 0 and not after:
        os.kill(os.getpid(), signal.SIGKILL)
    real(*names)
    if left == 0:
        os.kill(os.getpid(), signal.SIGKILL)
os.replace = replace
from greybox.cli import main
sys.exit(main(sys.argv[3:]))
"""


@pytest.mark.slow
def test_a_kill_at_any_write_leaves_files_that_load(tmp_path: Path) -> None:
    pytest.importorskip("gpytorch")
    train = write_log(tmp_path / "train.csv", 1, n=600)
    common = ["--inputs", "volt=a-b,load", "--outputs", "speed,temp", "--order", "1", "--json", "-"]
    assert (
        main(["linear", "--train", train, *common, "--siso", "--out", str(tmp_path / "siso")]) == 0
    )
    out = tmp_path / "hybrid"
    learn = [
        "learn",
        str(tmp_path / "siso" / "model.json"),
        "--train",
        train,
        "--points",
        "10",
        "--out",
        str(out),
    ]
    ended = kills = 0
    for n in range(1, 12):
        for when in ("before", "after"):
            process = subprocess.run(
                [sys.executable, "-c", KILLED, str(n), when, *learn],
                capture_output=True,
                check=False,
            )
            if process.returncode == 0:
                ended += 1
                continue
            assert process.returncode == -signal.SIGKILL, process.stderr
            kills += 1
            if (out / "learn.json").exists():
                assert (
                    json.loads((out / "learn.json").read_text())["schema"]
                    == "greybox.output_residual/1"
                )
            if (out / "hybrid.json").exists():
                OutputHybrid.load(out / "hybrid.json")
            assert (
                not (out / "report.html").exists() or when == "after"
            )  # the page of no earlier run stays
        if ended:
            break
    assert ended == 2
    assert kills >= 6  # hybrid, result twice, page
    assert {p.name for p in out.iterdir() if not p.name.startswith(".")} >= {
        "hybrid.json",
        "learn.json",
        "report.html",
    }
