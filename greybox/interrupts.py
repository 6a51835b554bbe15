"""Ctrl-C that is not lost inside CasADi.

CasADi's operators ask Python code of CasADi's what shape an operand has and whether it is an array,
and drop whatever that raises. An interrupt that arrives just then (one in three while a model is
built) vanishes, and the command runs on.
"""

from __future__ import annotations

import _thread
import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType

AGAIN = 0.002
"""Seconds after which an interrupt that came at the wrong moment comes again."""


@contextlib.contextmanager
def kept_interrupts() -> Iterator[None]:
    """SIGINT raises KeyboardInterrupt where it is not dropped: it waits until CasADi's conversion
    of an operand is over.

    Nothing changes outside the main thread, or where somebody handles SIGINT already.
    """
    ours = threading.current_thread() is threading.main_thread()
    if not ours or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    signal.signal(signal.SIGINT, _interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _interrupt(number: int, frame: FrameType | None) -> None:
    if not _converting(frame):
        signal.default_int_handler(number, frame)
    timer = threading.Timer(AGAIN, _thread.interrupt_main)
    timer.daemon = True
    timer.start()


def _converting(frame: FrameType | None) -> bool:
    """Whether the call stack goes from Python of CasADi's through its compiled part into Python of
    CasADi's.

    A callback of the user's, at which the way from the compiled part leads elsewhere, may be
    interrupted.
    """
    while frame is not None and (caller := frame.f_back) is not None:
        theirs = all(f.f_globals.get("__name__") == "casadi.casadi" for f in (frame, caller))
        if theirs and "_casadi" in caller.f_code.co_names:
            return True
        frame = caller
    return False
