"""Recording: what a log file of any format holds, before anything in it has one of our names.

A recording is a set of streams (topics, events, tables), each with stamps of its own. A `Source`
says which fields of which stream are a channel group, in which unit and frame; every reader lists
its sources in order of preference.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import os
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Protocol

import numpy as np
import numpy.typing as npt

from greybox.data.memory import allowance, bounded
from greybox.data.raw import FloatArray
from greybox.distribution import install_line
from greybox.errors import DataError, GreyboxError
from greybox.frames import GRAVITY

if TYPE_CHECKING:
    from greybox.data.logs.table import Table


@dataclass(frozen=True, kw_only=True, eq=False)
class Stream:
    """Samples that share their stamps. `t` (N,) [s] as logged; `fields` name -> (N,) float64;
    `kind` message type.

    `clock` says what the stamps are. A field that is no number is named in `unread`.
    """

    name: str
    t: FloatArray
    fields: Mapping[str, FloatArray]
    kind: str = ""
    clock: str = ""
    unread: tuple[str, ...] = ()

    @property
    def n(self) -> int:
        """Number of samples."""
        return int(self.t.size)

    @property
    def step(self) -> float:
        """Median step of the stamps [s]; infinite for fewer than two samples."""
        return float(np.median(np.abs(np.diff(self.t)))) if self.n > 1 else float("inf")

    @property
    def rate(self) -> float:
        """Samples per second by the median step; 0 where it is not known."""
        return 1.0 / self.step if 0 < self.step < float("inf") else 0.0


@dataclass(frozen=True, kw_only=True)
class Source:
    """Which fields of a stream are the channels of a `group`, in the order of the group's channels.

    A field may carry a minus sign; "" stands for one that is not there. `unit` is one of
    `UNITS[group]` and `frame` one of `FRAMES[group]` ("" = ours); `scale` multiplies after the
    unit, then `offset` is added, both of all fields or one for each. `limits` (low, high) maps
    commands to 0..1. The value belongs to its stamp minus `delay` [s]. `convert` (N, K) -> (N, K)
    comes first of all. `gravity=False`: it was taken out of a specific force. `causal=False`:
    smoothed with later samples.
    """

    group: str
    stream: str
    fields: tuple[str, ...]
    unit: str = ""
    frame: str = ""
    scale: float | tuple[float, ...] = 1.0
    offset: float | tuple[float, ...] = 0.0
    delay: float = 0.0
    limits: tuple[float, float] | None = None
    gravity: bool = True
    causal: bool = True
    convert: Callable[[FloatArray], FloatArray] | None = None
    note: str = field(default="", compare=False)


UNITS: Mapping[str, Mapping[str, float]] = {
    "command": {"1": 1.0},
    "rotor_speed": {"rad/s": 1.0, "rpm": np.pi / 30, "Hz": 2 * np.pi},
    "battery": {"V": 1.0, "mV": 1e-3},
    "attitude": {"1": 1.0, "rad": 1.0, "deg": np.pi / 180},
    "rate": {"rad/s": 1.0, "deg/s": np.pi / 180, "mrad/s": 1e-3},
    "specific_force": {"m/s^2": 1.0, "g": GRAVITY, "mg": 1e-3 * GRAVITY},
    "position": {"m": 1.0, "mm": 1e-3},
    "velocity": {"m/s": 1.0, "mm/s": 1e-3},
    "setpoint": {"m": 1.0, "mm": 1e-3},
}
"""Units that a source may have, with their factor to SI. Attitude: 1 for a quaternion, rad or deg
for Euler angles, and 1 for a rotation matrix."""

FRAMES: Mapping[str, tuple[str, ...]] = {
    "attitude": ("FLU/ENU", "FRD/NED"),
    "rate": ("FLU", "FRD", "ENU", "NED"),
    "specific_force": ("FLU", "FRD", "ENU", "NED"),
    "position": ("ENU", "NED"),
    "velocity": ("ENU", "NED", "FLU", "FRD"),
    "setpoint": ("ENU", "NED"),
}
"""Frames that a source may have; the first is ours. Groups without a frame are absent."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """A log file as its reader understands it: streams, sources in order of preference, and what
    else it says.

    `info` are facts for people (firmware, craft); `dropouts` (start, length) [s] where the logger
    says it lost data; `excitation` (N,) is what the firmware added to the set points of its own
    accord, on the stamps of the rows. `rotors` position (x, y, z) [m, FLU] and spin of every rotor
    where the log knows them, `parameters` the firmware's own.
    """

    format: str
    source: str
    sha256: str
    streams: Mapping[str, Stream]
    sources: tuple[Source, ...] = ()
    info: Mapping[str, str] = field(default_factory=dict)
    dropouts: tuple[tuple[float, float], ...] = ()
    rotors: tuple[tuple[tuple[float, float, float], int], ...] = ()
    parameters: Mapping[str, float] = field(default_factory=dict)
    excitation: FloatArray | None = None
    notes: tuple[str, ...] = ()


class ReadTable(Protocol):
    """What reads a file that is one table already."""

    def __call__(self, path: str | os.PathLike[str]) -> Table:
        """Raises `DataError`."""
        ...


@dataclass(frozen=True, kw_only=True)
class LogFormat:
    """One log format: how its files are recognised, what reads them, and how to log more.

    `endings` are lower-case file name endings, `recognise` judges the first bytes (or a folder). A
    format is a table with a time column (`table`) or many streams (`recording`). `libraries` are
    those that reading takes beyond what greybox always has. `advice` maps a channel group to the
    settings that make the logger record it; the key "" is about the log as a whole.
    """

    name: str
    title: str
    endings: tuple[str, ...]
    recognise: Callable[[Path, bytes], bool] = lambda path, head: False
    table: ReadTable | None = None
    recording: Callable[[Path], Recording] | None = None
    libraries: tuple[str, ...] = ()
    advice: Mapping[str, str] = field(default_factory=dict)


def library(name: str, *, where: str, what: str) -> ModuleType:
    """Import an optional library. Raises `DataError` with the way to install it."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        missing = error.name or name
        raise DataError(
            f"{what} needs the library '{missing.split('.')[0]}', which is not installed",
            where=where,
            fix=install_line("logs"),
        ) from None


@contextlib.contextmanager
def damaged(where: str, what: str, *, fix: str = "copy the log again") -> Iterator[None]:
    """Turn whatever a parser of foreign bytes raises into one `DataError`, within a bounded memory;
    its warnings are not ours to show.

    Parsers of damaged files fail in any way they like (struct, index, memory, recursion), so that
    the net is wide.
    """
    try:
        with warnings.catch_warnings(), bounded(where):
            warnings.simplefilter("ignore")
            yield
    except (GreyboxError, KeyboardInterrupt):
        raise
    except MemoryError:
        raise DataError(
            f"takes more than {allowance(where) / 2**30:.1f} GiB to read", where=where, fix=fix
        ) from None
    except Exception as error:
        text = str(error).strip().splitlines()
        said = f"{type(error).__name__}: {text[0][:120]}" if text else type(error).__name__
        raise DataError(f"cannot be read as {what} ({said})", where=where, fix=fix) from None


def checked_file(path: Path) -> str:
    """SHA-256 of a file (of all files of a folder). Raises `DataError` where there is nothing to
    read."""
    where = str(path)
    digest = hashlib.sha256()
    try:
        parts = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
        for part in parts:
            with part.open("rb") as stream:
                while block := stream.read(1 << 20):
                    digest.update(block)
    except FileNotFoundError:
        raise DataError("no such log", where=where, fix="check the path") from None
    except OSError as error:
        raise DataError(
            f"cannot read: {error.strerror or error}", where=where, fix="check the permissions"
        ) from None
    return digest.hexdigest()


def as_numbers(values: npt.ArrayLike) -> FloatArray | None:
    """One float64 per sample, or None for what is no number (text, bytes, objects)."""
    array = np.asarray(values)
    if array.dtype.kind not in "fiub" or array.ndim != 1:
        return None
    return np.asarray(array, dtype=np.float64)
