"""Compile generated C into a shared library, once per content: the build cache.

The key is the SHA-256 of sources, flags and compiler version, so that a cached library is never stale. The cache lives
in $GREYBOX_CACHE, else $XDG_CACHE_HOME/greybox, else ~/.cache/greybox; where that cannot be written a temporary folder
serves. Without a C compiler (or with GREYBOX_COMPILER=none) `compiler()` is None and callers use CasADi's VM.
"""

from __future__ import annotations

import functools
import hashlib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from greybox.errors import GreyboxError

MODEL_FLAGS = ("-O1", "-fPIC", "-w")
"""Straight-line generated code: -O1 is about as fast as -O2 and compiles several times quicker."""
SHARED = frozenset({"gb_driver.c", "gb_ekf.c"})
"""Hand-written sources, compiled once for all models."""
DRIVER_FLAGS = ("-O3", "-march=native", "-fPIC", "-w")


class BuildError(GreyboxError, RuntimeError):
    """The C compiler failed on generated code."""


@functools.cache
def compiler() -> str | None:
    """Path of the C compiler ($GREYBOX_COMPILER, $CC, cc, gcc or clang), or None."""
    chosen = os.environ.get("GREYBOX_COMPILER")
    if chosen == "none":
        return None
    for name in (chosen, os.environ.get("CC"), "cc", "gcc", "clang"):
        found = shutil.which(name) if name else None
        if found:
            return found
    return None


@functools.cache
def _version(path: str) -> str:
    done = subprocess.run([path, "--version"], capture_output=True, text=True, check=False)
    return done.stdout.splitlines()[0] if done.stdout else path


@functools.cache
def cache_dir() -> Path:
    """Folder of built libraries; made when it is not there."""
    for base in (
        os.environ.get("GREYBOX_CACHE"),
        os.path.join(os.environ["XDG_CACHE_HOME"], "greybox") if os.environ.get("XDG_CACHE_HOME") else None,
        os.path.join(os.path.expanduser("~"), ".cache", "greybox"),
    ):
        if base:
            try:
                path = Path(base) / "build"
                path.mkdir(parents=True, exist_ok=True)
                with tempfile.TemporaryFile(dir=path):
                    return path
            except OSError:
                continue
    return Path(tempfile.mkdtemp(prefix="greybox-build-"))


def _object(cc: str, name: str, text: str, flags: Sequence[str]) -> Path:
    """Where the object file of one source is kept."""
    digest = hashlib.sha256(f"{_version(cc)}\0{name}\0{' '.join(flags)}\0{text}".encode())
    return cache_dir() / f"{digest.hexdigest()}.o"


def _library(cc: str, sources: Sequence[tuple[str, str, Sequence[str]]], link: Sequence[str]) -> Path:
    """Where the library of these sources is kept."""
    digest = hashlib.sha256(_version(cc).encode())
    for name, text, flags in sources:
        digest.update(f"\0{name}\0{' '.join(flags)}\0{text}".encode())
    if link:
        digest.update(f"\0{' '.join(link)}".encode())
    return cache_dir() / f"{digest.hexdigest()}.so"


def build(
    sources: Sequence[tuple[str, str, Sequence[str]]],
    rewrite: Mapping[str, Callable[[str], str]] | None = None,
    *,
    link: Sequence[str] = (),
    instead: Mapping[str, Sequence[str]] | None = None,
) -> Path:
    """Shared library of C sources [(name, text, flags)] linked with the flags `link`.

    Where it is not in the cache, flags of the sources named in `instead` are replaced by these.

    Raises `BuildError` with the compiler's first complaint.

    `rewrite` turns the text of a named source into what is compiled. The key of the cache is the text before it, so
    that nothing is rewritten when the library is there.
    """
    cc = compiler()
    if cc is None:
        raise BuildError("no C compiler", fix="install gcc or clang; without one greybox runs in CasADi's VM")
    target = _library(cc, sources, link)
    if instead and not target.exists():
        sources = [(name, text, instead.get(name, flags)) for name, text, flags in sources]
        target = _library(cc, sources, link)
    if target.exists():
        return target
    with tempfile.TemporaryDirectory(dir=cache_dir(), prefix="build-") as folder:
        objects: list[str] = []
        running: list[tuple[subprocess.Popen[str], str, Path | None]] = []
        for name, text, flags in sources:
            # Sources that no rewriting touches and that are written by hand come again with every model.
            kept = _object(cc, name, text, flags) if name in SHARED else None
            path = Path(folder) / name
            objects.append(str(kept if kept is not None and kept.exists() else path.with_suffix(".o")))
            if objects[-1] == str(kept):
                continue
            path.write_text((rewrite or {}).get(name, str)(text))
            command = [cc, *flags, "-c", str(path), "-o", objects[-1]]
            running.append((subprocess.Popen(command, stderr=subprocess.PIPE, text=True), objects[-1], kept))
        for process, made, kept in running:
            _, complaint = process.communicate()
            if process.returncode:
                raise BuildError(f"the C compiler failed: {complaint.strip().splitlines()[:1]}", where=cc)
            if kept is not None:
                copy = Path(folder) / f"{kept.name}.copy"
                shutil.copyfile(made, copy)
                os.replace(copy, kept)
        library = str(Path(folder) / "out.so")
        done = subprocess.run(
            [cc, "-shared", "-o", library, *objects, *link, "-lm"], capture_output=True, text=True, check=False
        )
        if done.returncode:
            raise BuildError(f"linking failed: {done.stderr.strip().splitlines()[:1]}", where=cc)
        os.replace(library, target)
    return target
