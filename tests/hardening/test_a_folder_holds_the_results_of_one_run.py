"""Two commands do not write into one folder, and a command that is killed leaves results of one run
only.

What each command leaves at every moment is asked where its tests run it (`tests/one_run.py`).
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from greybox.cli import main
from greybox.files import OutputError, sole_writer, withdraw, write_atomic
from tests.one_run import results_of_one_run

HOLDER = """
import sys, time
from greybox.files import sole_writer
with sole_writer(sys.argv[1]):
    print("on", flush=True)
    time.sleep(60)
"""
posix = pytest.mark.skipif(sys.platform == "win32", reason="folders cannot be locked")


@posix
def test_the_second_writer_is_refused_until_the_first_is_gone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "a" / "out"
    held = [sys.executable, "-c", HOLDER, str(out)]
    with subprocess.Popen(held, stdout=subprocess.PIPE, text=True) as first:
        assert first.stdout is not None
        assert first.stdout.readline() == "on\n"
        command = ["plan", "--vehicle", "v.toml", "--out", str(out)]
        assert main(command) == 2
        assert "another greybox command writes into this folder" in capsys.readouterr().err
        first.kill()  # no chance to tidy up
    assert main(command) == 2
    assert "no such vehicle file" in capsys.readouterr().err
    with sole_writer(out):
        (out / "result").write_text("")
    assert [p.name for p in out.iterdir()] == ["result"]


@posix
def test_what_came_to_nothing_leaves_no_folder(tmp_path: Path) -> None:
    with (
        pytest.raises(OutputError),
        sole_writer(tmp_path / "b" / "c"),
        sole_writer(tmp_path / "b" / "c"),
    ):
        pass
    assert list(tmp_path.iterdir()) == []


def test_the_watch_sees_what_it_is_for(tmp_path: Path) -> None:
    with results_of_one_run(tmp_path, "a", "b") as seen:
        withdraw(tmp_path, "a", "b")
        write_atomic(tmp_path / "a", "new")
        write_atomic(tmp_path / "b", "new")
    assert seen[-1] == {"a", "b"}
    with (
        pytest.raises(AssertionError, match=r"old \(True\) beside new"),
        results_of_one_run(tmp_path, "a", "b"),
    ):
        write_atomic(tmp_path / "a", "new")
    with (
        pytest.raises(AssertionError, match="nothing was written"),
        results_of_one_run(tmp_path, "a"),
    ):
        pass
