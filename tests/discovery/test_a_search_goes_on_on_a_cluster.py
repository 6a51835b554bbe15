"""Fits on the workers of a real dask scheduler are those of one process, also where a worker is
killed; a cluster that cannot be used is said in one line."""

from __future__ import annotations

import concurrent.futures
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator

import pytest

import greybox.cluster
from greybox.cli import main
from greybox.cluster import Cluster
from greybox.discovery.evidence import Flights, Structure
from greybox.errors import GreyboxError
from tests.discovery import small_world

distributed = pytest.importorskip("distributed")
RIVALS: list[Structure] = [frozenset({"rotational_damping"}), frozenset({"gyro_bias"})]


def started(*command: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-m", *command],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
    )


@pytest.fixture
def cluster() -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """HOST:PORT of a scheduler, and its two workers and itself."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        host = f"127.0.0.1:{free.getsockname()[1]}"
    quiet = "--no-dashboard", "--no-show"
    ran = [started("distributed.cli.dask_scheduler", "--host", f"tcp://{host}", *quiet)]
    alone = "--nthreads", "1", "--no-nanny", "--no-dashboard"
    workers = [started("distributed.cli.dask_worker", f"tcp://{host}", *alone) for _ in range(2)]
    try:
        with distributed.Client(f"tcp://{host}", timeout=60, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=60)
        yield host, [*workers, *ran]
    finally:
        for process in (*ran, *workers):
            process.kill()
            process.wait()


def contested(flights: Flights) -> list[object]:
    return [f.known for f in flights.contest([(s, []) for s in RIVALS], flights.fit(()))]


def test_a_killed_worker_changes_no_number(
    cluster: tuple[str, list[subprocess.Popen[bytes]]], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(greybox.cluster, "PATIENCE", 1.0)
    alone = contested(small_world.damped())
    host, workers = cluster
    with monkeypatch.context() as patch:
        patch.setattr(greybox.cluster, "VERSION", "another")
        with pytest.raises(GreyboxError, match="another version"):
            Cluster(f"dask://{host}")
    with Cluster(f"dask://{host}") as executor:
        flights = small_world.damped()
        flights.executor = executor
        killer = threading.Timer(1.0, workers[0].kill)
        killer.start()
        assert contested(flights) == alone
        killer.join()
        assert workers[0].wait(timeout=60) != 0
        lost = executor.submit(time.sleep, 60.0)
        workers[1].kill()
        with pytest.raises(concurrent.futures.BrokenExecutor):  # the search goes on here
            lost.result(timeout=30)
        workers[2].kill()  # the scheduler
        time.sleep(0.5)
        with pytest.raises(concurrent.futures.BrokenExecutor):
            executor.submit(time.sleep, 0.0).result(timeout=30)


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("tcp://127.0.0.1:8786", "expected dask://HOST:PORT"),
        ("dask://127.0.0.1", "expected dask://HOST:PORT"),
    ],
)
def test_what_is_no_address_is_said_before_anything_is_read(
    address: str, said: str, capsys: pytest.CaptureFixture[str]
):
    words = ["discover", "--vehicle", "none.toml", "--train", "none.csv", "--executor", address]
    assert main(words) == 2
    told = capsys.readouterr().err
    assert said in told
    assert len(told.strip().splitlines()) == 1


def test_nobody_there(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(greybox.cluster, "PATIENCE", 0.5)
    with pytest.raises(GreyboxError, match="no scheduler answers"):
        Cluster("dask://127.0.0.1:9")
