"""The cache of what is compiled: what is taken from it is what was put there, by this user.

    <folder>/build/<key>             one line: SHA-256 and size of the file that belongs to the key
    <folder>/build/<SHA-256>.so      the file (.npz: slopes that were derived before)

The folder is $GREYBOX_CACHE, else $XDG_CACHE_HOME/greybox, else ~/.cache/greybox, the first that
can be written, lets programs be run, belongs to this user and that nobody else may write; else a
temporary one that goes with the process. A library is run as soon as it is opened, and one that is
cut short ends the process (SIGBUS): so size, SHA-256, owner and mode are checked before. What does
not fit is made again, and said. Files are whole on the disk before they get their names, so that a
crash leaves none in part, and files of two writers never mix.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import hashlib
import os
import shutil
import stat
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from greybox.errors import printable
from greybox.files import file_sha256

OTHERS = stat.S_IWGRP | stat.S_IWOTH


@functools.cache
def say(text: str) -> None:
    """A line on standard error, once."""
    print(f"greybox: {printable(text)}", file=sys.stderr)


def _candidates() -> Iterator[Path]:
    if own := os.environ.get("GREYBOX_CACHE"):
        yield Path(own)
    if xdg := os.environ.get("XDG_CACHE_HOME"):
        yield Path(xdg) / "greybox"
    with contextlib.suppress(RuntimeError):  # nobody's home
        yield Path.home() / ".cache" / "greybox"


@functools.cache
def cache_root() -> Path:
    """Folder of everything that is kept between processes; made when it is not there."""
    for root in _candidates():
        try:
            root.mkdir(parents=True, exist_ok=True, mode=0o700)
            refusal = _refusal(root)
        except OSError as error:
            refusal = error.strerror or str(error)
        if not refusal:
            return root
        say(f"{root} is not used as cache ({refusal}); set GREYBOX_CACHE to a folder of your own")
    root = Path(tempfile.mkdtemp(prefix="greybox-"))
    atexit.register(shutil.rmtree, root, ignore_errors=True)
    if _refusal(root):
        say(f"no folder for compiled models: {root} ({_refusal(root)})")
    return root


def is_kept() -> bool:
    """Whether `cache_root` is there when this process has ended."""
    return cache_root() in set(_candidates())


def cache_dir() -> Path:
    """Folder of compiled files."""
    path = cache_root() / "build"
    path.mkdir(exist_ok=True, mode=0o700)
    return path


def _refusal(folder: Path) -> str:
    """Why nothing that is run may be kept in a folder; empty where it may."""
    state = folder.stat()
    if (refusal := _foreign(state)) and hasattr(os, "getuid") and state.st_uid == os.getuid():
        # our own, made when others were let in: the files in it are looked at one by one
        folder.chmod(stat.S_IMODE(state.st_mode) & ~OTHERS)
        refusal = _foreign(folder.stat())
    if refusal:
        return refusal
    if hasattr(os, "statvfs") and os.statvfs(folder).f_flag & getattr(os, "ST_NOEXEC", 0):
        return "nothing may be run from there: it is mounted noexec"
    with tempfile.TemporaryFile(dir=folder) as probe:
        probe.write(b"greybox" * 1000)
        probe.flush()
    return ""


def _foreign(state: os.stat_result) -> str:
    """Who else may change what this is the state of; empty for nobody."""
    if not hasattr(os, "getuid"):
        return ""
    if state.st_uid != os.getuid():
        return f"it belongs to user {state.st_uid}"
    return "others may write it" if state.st_mode & OTHERS else ""


def find(key: str, suffix: str) -> Path | None:
    """The file that `keep` put there under a key, or None. One that is not as it was is taken
    away."""
    index = cache_dir() / key
    if not os.path.lexists(index):
        return None
    try:
        digest, size = _checked_text(index).split()
        path = cache_dir() / f"{digest}{suffix}"
        _check(path, digest, int(size))
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else error
        say(
            f"a compiled model in {cache_dir()} is not as it was written ({why}); it is built again"
        )
        with contextlib.suppress(OSError):
            index.unlink()
        return None
    return path


def _checked_text(path: Path) -> str:
    state = path.lstat()
    if not stat.S_ISREG(state.st_mode) or (why := _foreign(state)) or state.st_size > 200:
        raise ValueError(
            f"{path.name[:12]}: {why if stat.S_ISREG(state.st_mode) and why else 'no entry'}"
        )
    return path.read_text(encoding="ascii")


def _check(path: Path, digest: str, size: int) -> None:
    """Raises `OSError`, `ValueError` unless the file is whole and nobody else's."""
    state = path.lstat()
    if not stat.S_ISREG(state.st_mode):
        raise ValueError(f"{path.name[:12]}: not a file")
    if why := _foreign(state):
        raise ValueError(f"{path.name[:12]}: {why}")
    if state.st_size != size:
        raise ValueError(f"{path.name[:12]}: {state.st_size} bytes instead of {size}")
    if file_sha256(path) != digest:
        raise ValueError(f"{path.name[:12]}: wrong checksum")


def keep(key: str, made: Path, suffix: str) -> Path:
    """Move a finished file into the cache under a key; where it is then. `made` lies in
    `cache_dir()` or a folder in it. Raises `OSError`."""
    with open(made, "rb+") as stream:
        os.fsync(stream.fileno())
    made.chmod(0o700)
    digest, size = file_sha256(made), made.stat().st_size
    target = cache_dir() / f"{digest}{suffix}"
    os.replace(made, target)
    handle, name = tempfile.mkstemp(dir=cache_dir(), prefix="index-")
    with os.fdopen(handle, "w", encoding="ascii") as stream:
        stream.write(f"{digest} {size}\n")
        stream.flush()
        os.fsync(stream.fileno())
    os.replace(name, cache_dir() / key)
    return target


def key_of(*parts: str) -> str:
    """SHA-256 over texts."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(f"{len(part)}\0{part}\0".encode())
    return digest.hexdigest()
