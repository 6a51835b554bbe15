"""Results are whole or not there: full disks, devices and pipes as targets, kill -9 at any
moment."""

from __future__ import annotations

import json
import os
import signal
import stat
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from greybox.files import OutputError, write_atomic

GREYBOX = [sys.executable, "-m", "greybox.cli"]
full = pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")


@full
@pytest.mark.parametrize("arguments", [["effects"], ["effects", "--json", "-"]])
def test_a_full_disk_behind_standard_output_is_one_line(arguments: list[str]):
    with open("/dev/full", "w") as nowhere:
        done = subprocess.run(
            [*GREYBOX, *arguments], stdout=nowhere, stderr=subprocess.PIPE, text=True, check=False
        )
    assert done.returncode == 2
    assert done.stderr.strip().splitlines() == [
        "greybox effects: standard output: No space left on device"
    ]


@full
def test_a_device_is_written_to_and_not_replaced():
    with pytest.raises(OutputError, match="No space left"):
        write_atomic("/dev/full", "text")
    assert stat.S_ISCHR(os.stat("/dev/full").st_mode)


def test_a_pipe_is_written_to_and_not_replaced(tmp_path: Path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    got: list[str] = []
    reader = threading.Thread(target=lambda: got.append(pipe.read_text()))
    reader.start()
    write_atomic(pipe, "what was asked for")
    reader.join(10)
    assert got == ["what was asked for"]
    assert stat.S_ISFIFO(os.stat(pipe).st_mode)


def test_a_reader_that_leaves_early_is_no_error():
    with subprocess.Popen(
        [*GREYBOX, "effects"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.readline()
        process.stdout.close()
        assert process.stderr.read() == ""
        assert process.wait(30) == 0


WRITER = """
import sys
from greybox.files import write_json
path = sys.argv[1]
print("on", flush=True)
k = 0
while True:
    write_json(path, {"version": k, "load": [k] * 4000})
    k += 1
"""


def test_kill_9_leaves_the_old_or_the_new_result(tmp_path: Path):
    target = tmp_path / "model.json"
    rng = np.random.default_rng(0)
    last = -1
    for _ in range(12):
        with subprocess.Popen(
            [sys.executable, "-c", WRITER, str(target)], stdout=subprocess.PIPE, text=True
        ) as process:
            assert process.stdout is not None
            process.stdout.readline()
            time.sleep(float(rng.uniform(0, 0.05)))
            process.send_signal(signal.SIGKILL)
        if target.exists():
            content = json.loads(target.read_text())
            assert content["load"] == [content["version"]] * 4000
            last = max(last, content["version"])
    assert last >= 0, "no writer got as far as its first result"
