"""Compile generated C into a shared library, once per content: the build cache.

The key is the SHA-256 of sources, flags, compiler version and, with -march=native, the processor,
so that a cached library is never stale; `cache` says where it lives and when it is believed.
Without a C compiler (or with GREYBOX_COMPILER=none) `compiler()` is None and callers use CasADi's
VM, as they do with one that fails: `opened`. The wheel `ziglang` (extra `compiler`) brings one
where the system has none.
"""

from __future__ import annotations

import ctypes
import functools
import importlib.util
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path

from greybox.distribution import install_line
from greybox.errors import GreyboxError
from greybox.estimation.cache import cache_dir, cache_root, find, keep, key_of, say

Source = tuple[str, str, Sequence[str]]
"""File name, C text, flags of the compiler."""

MODEL_FLAGS = ("-O1", "-fPIC", "-w")
"""Straight-line generated code: -O1 is about as fast as -O2 and compiles several times quicker."""
SHARED = frozenset({"gb_driver.c", "gb_ekf.c", "gb_tape.c", "gb_write_tape.c"})
"""Hand-written sources, compiled once for all models."""
DRIVER_FLAGS = ("-O2", "-march=native", "-fPIC", "-w")
"""Hand-written sources, which say themselves which loops are to be written out: -O3 finds the same
ones and takes the compiler twice as long."""
LOOP_FLAGS = ("-O3", *DRIVER_FLAGS[1:])
"""... and those whose loops only -O3 turns into vectors."""


class BuildError(GreyboxError, RuntimeError):
    """The C compiler failed on generated code."""


Command = tuple[str, ...]
"""A program and the arguments that come before those of every call."""


@functools.cache
def compiler() -> Command | None:
    """How the C compiler is called: $GREYBOX_COMPILER, $CC, cc, gcc or clang, that of the wheel
    `ziglang`, or None."""
    chosen = os.environ.get("GREYBOX_COMPILER")
    if chosen == "none":
        return None
    for name in (chosen, os.environ.get("CC"), "cc", "gcc", "clang"):
        found = shutil.which(name) if name else None
        if found:
            return (found,)
    return from_wheel()


def from_wheel() -> Command | None:
    """The C compiler in the wheel `ziglang`, where that is installed. It would add traps for
    undefined behaviour to what is not optimised, which need a library of their own."""
    if not sys.executable or importlib.util.find_spec("ziglang") is None:
        return None
    os.environ.setdefault("ZIG_GLOBAL_CACHE_DIR", str(cache_root() / "zig"))
    return (sys.executable, "-P", "-m", "ziglang", "cc", "-fno-sanitize=undefined")


@functools.cache
def version(cc: Command) -> str:
    """The first line of what a compiler says of itself."""
    done = subprocess.run([*cc, "--version"], capture_output=True, check=False)
    return done.stdout.decode(errors="replace").splitlines()[0] if done.stdout else " ".join(cc)


@functools.cache
def _processor(cc: Command) -> str:
    """What -march=native stands for here: the processor's instructions, as the compiler's macros. A
    cache may travel with a home or an image to a machine that lacks some."""
    done = subprocess.run(
        [*cc, "-march=native", "-dM", "-E", "-x", "c", os.devnull],
        capture_output=True,
        check=False,
    )
    return (
        done.stdout.decode(errors="replace")
        if done.returncode == 0
        else f"{platform.machine()} {platform.processor()}"
    )


def _compiled_for(cc: Command, flags: Iterable[str]) -> str:
    """What the result depends on besides sources and flags."""
    return version(cc) + (_processor(cc) if "-march=native" in flags else "")


def _object(cc: Command, name: str, text: str, flags: Sequence[str]) -> str:
    """Key of the object file of one source."""
    return key_of(_compiled_for(cc, flags), name, " ".join(flags), text)


def _library(cc: Command, sources: Sequence[Source], link: Sequence[str]) -> str:
    """Key of the library of these sources."""
    every = {flag for _, _, flags in sources for flag in flags}
    parts = [part for name, text, flags in sources for part in (name, " ".join(flags), text)]
    return key_of(_compiled_for(cc, every), *parts, " ".join(link))


def build(
    sources: Sequence[Source], *, link: Sequence[str] = (), shared: frozenset[str] = SHARED
) -> Path:
    """Shared library of C sources [(name, text, flags)] linked with the flags `link`; the objects
    of those with names out of `shared`, which other libraries hold as well, are kept.

    Raises `BuildError` with the compiler's first complaint.
    """
    cc = compiler()
    if cc is None:
        raise BuildError(
            "no C compiler", fix=f"{install_line('compiler')}, or install gcc or clang"
        )
    key = _library(cc, sources, link)
    if (found := find(key, ".so")) is not None:
        return found
    try:
        with tempfile.TemporaryDirectory(dir=cache_dir(), prefix="build-") as folder:
            objects = _objects(cc, sources, Path(folder), shared)
            library = Path(folder) / "out.so"
            _run([*cc, "-shared", "-o", str(library), *map(str, objects), *link, "-lm"], cc)
            return keep(key, library, ".so")
    except OSError as error:
        raise BuildError(
            f"cannot compile: {error.strerror or error}",
            where=str(error.filename or cc[0]),
            fix="free some space, or set GREYBOX_CACHE to another folder",
        ) from None


def _objects(
    cc: Command, sources: Sequence[Source], folder: Path, shared: frozenset[str]
) -> list[Path]:
    """Object files of the sources, compiled side by side; those of `shared` names come from the
    cache."""
    objects: list[Path] = []
    running: list[tuple[subprocess.Popen[str], int, str | None]] = []
    for name, text, flags in sources:
        key = _object(cc, name, text, flags) if name in shared else None
        if key is not None and (found := find(key, ".o")) is not None:
            objects.append(found)
            continue
        path = folder / name
        path.write_text(text, encoding="utf-8")
        command = [*cc, *flags, "-c", str(path), "-o", str(path.with_suffix(".o"))]
        process = subprocess.Popen(
            command, stderr=subprocess.PIPE, text=True, encoding="utf-8", errors="replace"
        )
        running.append((process, len(objects), key))
        objects.append(path.with_suffix(".o"))
    complaints = [process.communicate()[1] for process, _, _ in running]
    for (process, at, key), complaint in zip(running, complaints, strict=True):
        if process.returncode:
            raise _failed(cc, process.returncode, complaint)
        if key is not None:
            objects[at] = keep(key, objects[at], ".o")
    return objects


def _run(command: Sequence[str], cc: Command) -> None:
    done = subprocess.run(
        command, capture_output=True, text=True, encoding="utf-8", errors="replace", check=False
    )
    if done.returncode:
        raise _failed(cc, done.returncode, done.stderr)


def _failed(cc: Command, code: int, complaint: str) -> BuildError:
    first = next((line for line in complaint.splitlines() if line.strip()), f"code {code}")
    return BuildError(f"the C compiler failed: {first.strip()}", where=" ".join(cc))


def opened(sources: Sequence[Source]) -> ctypes.CDLL | None:
    """The library of `build`, loaded; None where that cannot be, which is said once and kept in
    `trouble`: the caller then goes on in CasADi's VM."""
    if compiler() is None:
        return None
    try:
        path = build(sources)
        try:
            return ctypes.CDLL(str(path))
        except OSError as error:
            raise BuildError(f"a compiled model cannot be loaded: {error}") from None
    except BuildError as error:
        if not _TROUBLE:
            say(f"{error}; CasADi's VM runs the same equations, slower")
        _TROUBLE.append(str(error))
        return None


_TROUBLE: list[str] = []


def trouble() -> str:
    """Why models do not run compiled: what the compiler said last, or that there is none."""
    return _TROUBLE[-1] if _TROUBLE else "no C compiler was used"
