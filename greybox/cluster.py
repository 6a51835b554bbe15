"""Cluster: workers on other machines, under a dask.distributed scheduler."""

from __future__ import annotations

import concurrent.futures
import contextlib
import logging
import threading
import time
from collections.abc import Callable
from typing import ParamSpec, Protocol, TypeVar

from greybox.distribution import VERSION, install_line
from greybox.errors import GreyboxError, MissingExtraError

SCHEME = "dask://"
PATIENCE = 10.0
"""Seconds in which a scheduler must answer, and for which a cluster may be without workers."""
P = ParamSpec("P")
T = TypeVar("T")
Gives = TypeVar("Gives", covariant=True)


def host_of(address: str) -> str:
    """HOST:PORT of dask://HOST:PORT. Raises `GreyboxError` for anything else."""
    host = address.removeprefix(SCHEME)
    name, _, port = host.rpartition(":")
    if host == address or not name or not port.isdigit():
        raise GreyboxError(
            "--executor takes the address of a dask scheduler",
            expected=f"{SCHEME}HOST:PORT",
            got=address,
            fix="what `dask scheduler` prints, with dask:// for tcp://",
        )
    return host


class Cluster(concurrent.futures.Executor):
    """The workers of the scheduler at `address` (dask://HOST:PORT). A task whose worker dies goes
    to another one. Where none is left for `PATIENCE`, `result` raises `BrokenExecutor`.

    Raises `GreyboxError` where nobody answers or workers have another version of greybox, and
    `MissingExtraError` without dask.distributed.
    """

    def __init__(self, address: str) -> None:
        host = host_of(address)
        try:
            from distributed import Client
        except ImportError:
            raise MissingExtraError(
                "a cluster needs dask.distributed", fix=install_line("cluster")
            ) from None
        # What becomes of workers and connections comes back as errors of the tasks.
        logging.getLogger("distributed").setLevel(logging.CRITICAL)
        try:
            self._client = Client(f"tcp://{host}", timeout=PATIENCE, set_as_default=False)
        except OSError:
            raise GreyboxError(
                f"no scheduler answers at {address}",
                fix="start one with `dask scheduler`, and workers with `dask worker HOST:PORT`",
            ) from None
        try:
            self._demand_workers(address)
        except BaseException:
            self._client.close()
            raise
        self._open = set[_Unanswered]()
        self._left = threading.Event()
        threading.Thread(target=self._watch, daemon=True).start()

    def _demand_workers(self, address: str) -> None:
        """Every machine has this greybox: the scheduler, too, looks at what is sent."""
        try:
            workers = self._client.run(_version)
            versions = {"the scheduler": self._client.run_on_scheduler(_version), **workers}
        except Exception as error:
            raise GreyboxError(
                f"a machine of {address} cannot import greybox",
                got=str(error).splitlines()[0],
                fix=f"install greybox {VERSION} on the machines of scheduler and workers",
            ) from None
        if not workers:
            raise GreyboxError(
                f"the scheduler at {address} has no workers",
                fix=f"on every machine: dask worker {host_of(address)}",
            )
        for machine, version in versions.items():
            if version != VERSION:
                raise GreyboxError(
                    f"{machine} of {address} has another version of greybox",
                    expected=VERSION,
                    got=version,
                    fix="install the same version on every machine",
                )

    def submit(
        self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs
    ) -> concurrent.futures.Future[T]:
        """As of any executor."""
        answer: concurrent.futures.Future[T] = concurrent.futures.Future()
        self._open.add(answer)
        answer.add_done_callback(self._open.discard)
        try:
            sent = self._client.submit(fn, *args, **kwargs, pure=False)
        except Exception as error:  # its scheduler is gone
            _fail(answer, concurrent.futures.BrokenExecutor(str(error)))
        else:
            sent.add_done_callback(lambda done: _told(done, answer))
        return answer

    def _watch(self) -> None:
        """Give up what nobody works on: a scheduler would wait for workers for ever."""
        seen = time.monotonic()
        while not self._left.wait(PATIENCE / 10):
            if self._client.status == "running" and self._client.scheduler_info()["workers"]:
                seen = time.monotonic()
            elif time.monotonic() - seen > PATIENCE:
                for answer in tuple(self._open):
                    _fail(answer, concurrent.futures.BrokenExecutor("no workers are left"))

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Leave the cluster: what it still does for this process is cancelled."""
        del wait, cancel_futures
        self._left.set()
        self._client.close()


def _version() -> str:
    return VERSION


class _Task(Protocol[Gives]):
    """A task that was sent to the cluster."""

    def result(self) -> Gives:
        """What it gave; raises what it raised."""
        ...


class _Unanswered(Protocol):
    """An answer that is still open, whatever it will be of."""

    def set_exception(self, exception: BaseException | None, /) -> None:
        """There will be none."""


def _told(done: _Task[T], answer: concurrent.futures.Future[T]) -> None:
    """Pass on what a task of the cluster gave."""
    from distributed import KilledWorker
    from distributed.comm import CommClosedError

    lost = KilledWorker, CommClosedError, concurrent.futures.CancelledError
    try:
        value = done.result()
    except lost as error:
        _fail(answer, concurrent.futures.BrokenExecutor(str(error)))
    except BaseException as error:
        _fail(answer, error)
    else:
        with contextlib.suppress(concurrent.futures.InvalidStateError):
            answer.set_result(value)


def _fail(answer: _Unanswered, error: BaseException) -> None:
    with contextlib.suppress(concurrent.futures.InvalidStateError):  # it was given up before
        answer.set_exception(error)
