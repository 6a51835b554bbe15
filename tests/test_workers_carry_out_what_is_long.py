"""Workers: what is short is done here, what is long in processes, and an error or an end leaves no
process behind."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import greybox.cores
import greybox.workers
from greybox.workers import Workers


def waited(seconds: float) -> int:
    """The process that waited."""
    time.sleep(seconds)
    return os.getpid()


def test_short_tasks_stay_here_and_long_ones_send_the_next_away(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(greybox.workers, "LONG", 0.05)
    monkeypatch.setattr(greybox.workers, "cores", lambda: 2)
    with Workers() as workers:
        assert [workers.submit(waited, 0.0).result() for _ in range(2)] == [os.getpid()] * 2
        assert workers.submit(waited, 0.1).result() == os.getpid()
        sent = [workers.submit(waited, 0.2) for _ in range(2)]
        assert os.getpid() not in {f.result() for f in sent}
        with pytest.raises(TypeError):
            workers.submit(waited, "long").result()  # type: ignore[arg-type]
    assert not multiprocessing.active_children()


def test_one_core_has_no_processes(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(greybox.workers, "LONG", 0.0)
    monkeypatch.setattr(greybox.workers, "cores", lambda: 1)
    with Workers() as workers:
        assert workers.submit(waited, 0.0).result() == os.getpid()
        with pytest.raises(ZeroDivisionError):
            workers.submit(divmod, 1, 0).result()


def ignored() -> bool:
    """Whether Ctrl-C says nothing to this process."""
    return signal.getsignal(signal.SIGINT) is signal.SIG_IGN


def test_only_the_main_process_is_interrupted(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(greybox.workers, "LONG", 0.0)
    monkeypatch.setattr(greybox.workers, "cores", lambda: 2)
    with Workers() as workers:
        assert workers.submit(ignored).result()


def test_a_worker_uses_its_share_of_the_cores(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(greybox.workers, "LONG", 0.0)
    monkeypatch.setattr(greybox.workers, "cores", lambda: 2)
    with Workers() as workers:
        assert workers.submit(greybox.cores.cores).result() == 1


PARENT = """
import os, time
import greybox.workers
from tests.test_workers_carry_out_what_is_long import waited
greybox.workers.LONG, greybox.workers.cores = 0.0, lambda: 2
if __name__ == "__main__":
    workers = greybox.workers.Workers()
    print(workers.submit(waited, 0.0).result(), flush=True)
    time.sleep(600)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="processes are asked by signals")
def test_a_killed_parent_leaves_no_worker(tmp_path: Path):
    (tmp_path / "parent.py").write_text(PARENT)
    root = Path(__file__).parents[1]
    with subprocess.Popen(
        [sys.executable, str(tmp_path / "parent.py")],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(root)},
    ) as parent:
        assert parent.stdout is not None
        worker = int(parent.stdout.readline())
        parent.kill()
    for _ in range(200):
        try:
            os.kill(worker, 0)
        except ProcessLookupError:
            return
        if (
            Path(f"/proc/{worker}/stat").exists()
            and ") Z " in Path(f"/proc/{worker}/stat").read_text()
        ):
            return
        time.sleep(0.05)
    raise AssertionError("the worker lives on")


def test_an_interrupt_ends_them_at_once(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(greybox.workers, "LONG", 0.0)
    monkeypatch.setattr(greybox.workers, "cores", lambda: 2)
    began = time.perf_counter()

    def interrupted() -> None:
        with Workers() as workers:
            workers.submit(waited, 600.0)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert time.perf_counter() - began < 60.0
    assert not multiprocessing.active_children()
