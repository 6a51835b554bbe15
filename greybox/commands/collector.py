"""When a command lets Python's collector of cycles run.

It looks at all objects again and again. Modules and flights last as long as the command, and what a
page is drawn with is many small objects, gone when the command ends.
"""

from __future__ import annotations

import contextlib
import gc
from collections.abc import Iterator


@contextlib.contextmanager
def what_is_there_stays() -> Iterator[None]:
    """The collector leaves alone what there is by now."""
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


@contextlib.contextmanager
def nothing_collected() -> Iterator[None]:
    """No collection within."""
    was = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was:
            gc.enable()
