"""Workers: what is short is done here, what is long in processes, and an error or an end leaves no
process behind."""

from __future__ import annotations

import multiprocessing
import os
import time

import pytest

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
