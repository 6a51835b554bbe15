"""Workers: processes beside this one, for what a command can do side by side."""

from __future__ import annotations

import concurrent.futures
import contextlib
import multiprocessing
import os
import pickle
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from multiprocessing import resource_tracker
from types import TracebackType
from typing import ParamSpec, TypeVar

from greybox.cores import cores, limit_cores

LONG = 1.0
"""Seconds that a task must take before processes are started: each takes as long to begin."""
MOST = 4
"""Processes at most: each may need a gigabyte."""
P = ParamSpec("P")
T = TypeVar("T")


class Workers(concurrent.futures.Executor):
    """Carries tasks out here until one has taken `LONG`; from then on in processes, one for every
    core. Only the main process is interrupted: Ctrl-C ends the workers with it, and no task of
    theirs prints anything."""

    def __init__(self) -> None:
        self._count = min(cores(), MOST)
        self._longest = 0.0
        self._pool: concurrent.futures.ProcessPoolExecutor | None = None

    def submit(
        self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs
    ) -> concurrent.futures.Future[T]:
        """As of any executor; what it raises here is kept for `result`, too."""
        if self._count < 2 or self._longest < LONG:
            return self._here(fn, *args, **kwargs)
        with _uninterrupted():  # until they have started: processes inherit what is blocked
            if self._pool is None:
                spawn = multiprocessing.get_context("spawn")
                self._pool = concurrent.futures.ProcessPoolExecutor(
                    self._count,
                    mp_context=spawn,
                    initializer=_follow,
                    initargs=(max(1, cores() // self._count),),
                )
            return self._pool.submit(fn, *args, **kwargs)

    def _here(
        self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs
    ) -> concurrent.futures.Future[T]:
        done: concurrent.futures.Future[T] = concurrent.futures.Future()
        began = time.perf_counter()
        try:
            done.set_result(fn(*args, **kwargs))
        except Exception as error:
            done.set_exception(error)
        self._longest = max(self._longest, time.perf_counter() - began)
        return done

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the processes once they have done what they were given."""
        if self._pool is not None:
            self._pool.shutdown(wait, cancel_futures=cancel_futures)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> bool | None:
        if kind is not None and self._pool is not None:  # nobody waits for their results
            for process in multiprocessing.active_children():
                process.kill()
        self.shutdown(wait=True, cancel_futures=True)
        return None


def side_by_side(
    executor: concurrent.futures.Executor,
    call: Callable[..., T],
    common: Sequence[object],
    tasks: Mapping[int, object],
) -> Iterator[tuple[int, T]]:
    """(place, call(*common, task)) of the tasks by their places, as they end: of none where these
    cannot be sent to other processes, of those that had ended where one of these was killed."""
    try:
        pickle.dumps((common, tasks))
    except (pickle.PicklingError, AttributeError, TypeError):
        return
    with contextlib.suppress(concurrent.futures.BrokenExecutor):
        sent = {executor.submit(call, *common, task): place for place, task in tasks.items()}
        for done in concurrent.futures.as_completed(sent):
            yield sent[done], done.result()


def _follow(share: int) -> None:
    """In a worker: Ctrl-C is the main process's, and where that is gone there is nobody to work
    for. It has a `share` of the cores: threads of busy processes only wait for each other."""
    limit_cores(share)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()

    def watch() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextlib.contextmanager
def _uninterrupted() -> Iterator[None]:
    """Ctrl-C waits; where the system cannot block it, it may come."""
    if sys.platform == "win32":
        yield
        return
    resource_tracker.ensure_running()  # which lets it in again where it starts
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
