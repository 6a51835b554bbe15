"""Real disks that are full, read-only or run no programs: a fit ends well or in one line, and never
with half a file.

The disks are mounts in a namespace of the test's own (`unshare -rm`, Linux).
"""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from greybox.examples import flight_path, vehicle_path

ARPL = "arpl_crazyflie"
FIT = [
    *(sys.executable, "-m", "greybox", "fit", "--manual", "--vehicle", str(vehicle_path(ARPL))),
    *("--train", str(flight_path(ARPL, "log16")), "--rate", "20", "--effects", "motor_lag"),
    *("--max-iterations", "1"),
]


def can_mount() -> bool:
    """Whether this user may mount in a namespace of its own."""
    if sys.platform != "linux" or not shutil.which("unshare"):
        return False
    mounted = ["unshare", "-rm", "mount", "-t", "tmpfs", "tmpfs", "/mnt"]
    return subprocess.run(mounted, capture_output=True, check=False).returncode == 0


pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not can_mount(), reason="no mounts in a namespace of one's own"),
]


def on(
    folder: Path, options: str, command: list[str], after: str = "", **environment: str
) -> subprocess.CompletedProcess[str]:
    """Run a command where `folder` is a disk with these mount options; `after` (shell) runs behind
    it."""
    folder.mkdir(exist_ok=True)
    there = shlex.quote(str(folder))
    script = f"mount -t tmpfs -o size=4m tmpfs {there} && "
    if options:
        script += f"mount -o remount,{options} {there} && "
    script += f"{{ {shlex.join(command)}; code=$?; {after or ':'}; exit $code; }}"
    kept = {k: v for k, v in os.environ.items() if k not in ("GREYBOX_CACHE", "XDG_CACHE_HOME")}
    return subprocess.run(
        ["unshare", "-rm", "sh", "-c", script],
        env={**kept, **environment},
        capture_output=True,
        text=True,
        check=False,
        timeout=600,
    )


def greybox_lines(text: str) -> list[str]:
    """What greybox itself says on standard error."""
    assert "Traceback" not in text, text
    return [line for line in text.splitlines() if line.startswith("greybox: ")]


def test_where_no_program_may_run_the_same_equations_run_without_the_compiler(
    tmp_path: Path,
) -> None:
    disk, out = tmp_path / "noexec", tmp_path / "out"
    done = on(disk, "noexec", [*FIT, "--out", str(out)], HOME=str(disk), TMPDIR=str(disk))
    assert done.returncode in (0, 1, 3), done.stderr
    said = greybox_lines(done.stderr)
    assert sum("noexec" in line for line in said) >= 1, done.stderr
    assert any("CasADi's VM runs the same equations" in line for line in said), done.stderr
    assert (out / "model.json").exists()


def test_a_read_only_home_costs_the_cache_alone(tmp_path: Path) -> None:
    disk, out = tmp_path / "home", tmp_path / "out"
    done = on(disk, "ro", [*FIT, "--out", str(out)], HOME=str(disk))
    assert done.returncode in (0, 1, 3), done.stderr
    (line,) = greybox_lines(done.stderr)
    assert "is not used as cache (Read-only file system)" in line
    assert (out / "model.json").exists()


@pytest.mark.parametrize("left", [0, 2])
def test_a_disk_that_is_full_or_fills_up_is_one_line(left: int, tmp_path: Path) -> None:
    """`left` KiB are free: none at all, or too few for model.json."""
    disk = tmp_path / "disk"
    fill = f"echo old > {disk}/out/fit.json; dd if=/dev/zero of={disk}/ballast bs=1k 2>/dev/null;"
    free = f"truncate -s -{4 * left}k {disk}/ballast;"
    command = [
        "sh",
        "-c",
        f"mkdir {disk}/out; {fill} {free if left else ''} "
        f"{shlex.join([*FIT, '--out', f'{disk}/out'])}",
    ]
    done = on(disk, "", command, after=f"ls -A {disk}/out")
    assert done.returncode == 2, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    last = done.stderr.strip().splitlines()[-1]
    assert "cannot write: No space left on device" in last
    assert last.startswith("greybox fit: ")
    assert ".part" not in done.stdout
    assert "model.json" not in done.stdout
