"""Memory that the reader of a log may take: a small file must not unpack into all that the machine
has.

Parsers of other formats believe what a file declares. While one runs, the address space of this
process may grow by `allowance` only (Linux; elsewhere nothing is bounded), and the parser's own
MemoryError says that it wanted more.
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Iterator
from pathlib import Path

LEAST = 2 * 2**30
"""Bytes that any log may take [B]: libraries set addresses aside that they never use."""
PER_BYTE = 50
"""Bytes for every byte of the file: numbers of a compressed table are 10 to 20 times as large in
memory."""

_lock = threading.Lock()
_inside = 0
_before: tuple[int, int] | None = None
_limit = 0


def allowance(path: str | os.PathLike[str]) -> int:
    """Bytes that reading this file or folder may take."""
    place = Path(path)
    parts = place.rglob("*") if place.is_dir() else (place,)
    try:
        return LEAST + PER_BYTE * sum(p.stat().st_size for p in parts if p.is_file())
    except OSError:
        return LEAST


@contextlib.contextmanager
def bounded(path: str | os.PathLike[str]) -> Iterator[None]:
    """Nothing inside may take more than `allowance(path)`: a MemoryError there, or what a library
    makes of it."""
    global _inside, _before, _limit
    try:
        import resource

        used = int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[0]) * os.sysconf(
            "SC_PAGE_SIZE"
        )
    except (ImportError, OSError, ValueError):
        yield
        return
    with _lock:
        if _inside == 0:
            _before, _limit = resource.getrlimit(resource.RLIMIT_AS), 0
        assert _before is not None
        _inside += 1
        # Readers that run side by side share the largest limit.
        limit = _limit = max(_limit, used + allowance(path))
        soft, hard = _before
        for other in (soft, hard):
            limit = limit if other == resource.RLIM_INFINITY else min(limit, other)
        resource.setrlimit(resource.RLIMIT_AS, (limit, hard))
    try:
        yield
    finally:
        with _lock:
            _inside -= 1
            if _inside == 0:
                resource.setrlimit(resource.RLIMIT_AS, _before)
