"""Journal: what long work has found so far, an answer a line, so that the same work goes on where
it was stopped.

Work that is a function of what it was given asks the same questions in the same order. An answer
stands under the checksum of what was given, of all answers before, and of its question: where
anything differs no line fits, and the work is done as if there were none. A line that was cut off,
or is not as it was written, counts as not there.

    {"schema": "greybox.journal/1", "given": {"file a.csv": SHA-256, "--alpha": "0.05", ...}}
    {"key": SHA-256, "sum": SHA-256 of key and answer, "seconds": 3.2, "answer": ...}
"""

from __future__ import annotations

import base64
import contextlib
import contextvars
import dataclasses
import enum
import hashlib
import json
import math
import os
import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt

from greybox.errors import DataError, ModelError
from greybox.files import Json, append_json_line, of_another_version, write_atomic

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

FILE = "unfinished.jsonl"
"""Name of a journal beside the results of the work."""
SCHEMA = "greybox.journal/1"
MOST = 2**30
"""Bytes of a journal beyond which nothing more is kept."""
FIRST_LINE = 2**20
"""Bytes of the line that says what was given."""
LINE = re.compile(rb'\{"key": "([0-9a-f]{64})"')
CONTAINERS = {"list": list, "frozenset": frozenset, "dict": dict}
"""What stands under its name; a tuple is an array of JSON."""
NAMES = 3
"""Names of what differs that are said."""
T = TypeVar("T")
Kind: TypeAlias = "type[DataclassInstance] | type[enum.Enum]"
Kinds = Sequence[Kind]
"""Dataclasses and enums that an answer is made of; numbers, texts, tuples and arrays need none."""
Work = Callable[[Sequence[int]], Iterable[tuple[int, T]]]
"""Places among the questions -> (place, answer) of each, as they are found."""


class Journal:
    """The journal at `path` of work that was `given` all this (name -> checksum or text).
    `going_on` is what to say of what was there: "" for nothing. `spared` are the seconds that
    answers had taken that were there already, `kept` is how many there are."""

    def __init__(self, path: Path, given: Mapping[str, str]) -> None:
        self._path, self._given = path, dict(given)
        self._state = _sha(self._given)
        self._there: dict[str, int] = {}
        self._began = self._closed = self._folder = False
        self.going_on, self.spared, self.kept, self._inner = "", 0.0, 0, 0.0
        with contextlib.suppress(FileNotFoundError):
            self._read()

    def _read(self) -> None:
        """Find the places of the lines, where they are of the same work."""
        try:
            with self._path.open("rb") as stream:
                head = json.loads(stream.readline(FIRST_LINE))
                schema = head["schema"]
                if not of_another_version(schema, SCHEMA):
                    raise ValueError("not a journal")
                if schema != SCHEMA:
                    other = "written by another version of greybox"
                    self.going_on = f"{self._path} was {other}: all starts anew"
                    return
                if os.path.getsize(self._path) > 2 * MOST:
                    raise ValueError("longer than any journal")
                if other := _differing(dict(head["given"]), self._given):
                    self.going_on = f"{self._path} is of other input ({other}): all starts anew"
                    return
                self._began, at = True, stream.tell()
                for line in stream:
                    if found := LINE.match(line):
                        self._there[found[1].decode()] = at
                    at += len(line)
        except FileNotFoundError:
            raise
        except (OSError, ValueError, TypeError, KeyError, RecursionError):
            self._closed = True
            self.going_on = (
                f"{self._path} is no journal of greybox: nothing is kept for a later run"
            )
            return
        self.kept = len(self._there)
        if self.kept:
            self.going_on = f"going on where it was stopped, after {fits(self.kept)}"

    def answers(
        self, questions: Sequence[object], work: Work[T], whole: type[T], parts: Kinds
    ) -> list[T]:
        """As the function of this name."""
        kinds = {k.__name__: k for k in parts}
        state = self._state  # what `work` asks in its turn comes and goes with its answers
        keys = [_sha([state, k, plain(q)]) for k, q in enumerate(questions)]
        found, sums = dict[int, T](), dict[int, str]()
        for place, key in enumerate(keys):
            with contextlib.suppress(OSError, ValueError, TypeError, KeyError, RecursionError):
                found[place], sums[place] = self._recalled(key, whole, kinds)
        asked = [k for k in range(len(keys)) if k not in found]
        begun = then = time.perf_counter()
        outer, self._inner = self._inner, 0.0
        try:
            for place, answer in work(asked) if asked else ():
                now = time.perf_counter()
                own = now - then - self._inner  # what it asked in its turn counts there
                found[place], sums[place] = answer, self._noted(keys[place], answer, own)
                then, self._inner = now, 0.0
        finally:
            self._inner = outer + time.perf_counter() - begun
        self._state = _sha([state, [sums[k] for k in range(len(keys))]])
        return [found[k] for k in range(len(keys))]

    @contextlib.contextmanager
    def apart(self, name: str) -> Iterator[None]:
        """As the function of this name."""
        before, self._state = self._state, _sha([self._given, name])
        try:
            yield
        finally:
            self._state = before

    def _recalled(self, key: str, whole: type[T], kinds: Mapping[str, Kind]) -> tuple[T, str]:
        """The answer under a key, and its checksum. Raises `KeyError`, `ValueError`, ... where
        there is none, or not as it was written."""
        with self._path.open("rb") as stream:
            stream.seek(self._there.pop(key))
            row = json.loads(stream.readline())
        if row["key"] != key or row["sum"] != _sha([key, row["answer"]]):
            raise ValueError("not as it was written")
        answer = restored(row["answer"], kinds)
        if not isinstance(answer, whole):
            raise TypeError(f"an answer of {type(answer).__name__}")
        self.spared += max(0.0, float(row["seconds"]))
        return answer, row["sum"]

    def _noted(self, key: str, answer: object, seconds: float) -> str:
        """Keep an answer, as long as there is room; its checksum, "" of one that cannot be kept (of
        a solver of the user's own)."""
        try:
            content = plain(answer)
        except TypeError:
            return ""
        told = _sha([key, content])
        row = {"key": key, "sum": told, "seconds": round(seconds, 3), "answer": content}
        try:
            if not self._began and not self._closed:
                head = {"schema": SCHEMA, "given": self._given}
                self._folder = not self._path.parent.exists()
                write_atomic(self._path, json.dumps(head) + "\n")
                self._began = True
            if not self._closed and self._path.stat().st_size < MOST:
                append_json_line(self._path, row, synced=False)
                self.kept += 1
        except OSError:  # no room: the work itself goes on
            self._closed = True
        return told

    def end(self) -> None:
        """The work is done, or would end the same way again: nothing is left to go on with, nor a
        folder that was made for it and is empty."""
        if self._began:
            with contextlib.suppress(OSError):
                self._path.unlink()
                if self._folder:
                    self._path.parent.rmdir()


_CURRENT: contextvars.ContextVar[Journal | None] = contextvars.ContextVar("journal", default=None)


@contextlib.contextmanager
def kept_in(path: Path, given: Mapping[str, str]) -> Iterator[Journal]:
    """Answers within are kept in the journal at `path`, and taken from there; it goes where the
    work ends well, or refuses what it was given (`DataError`, `ModelError`), as it would again.
    `given`: all that the work depends on, name -> checksum or text. Threads and processes started
    within keep nothing."""
    journal = Journal(path, given)
    token = _CURRENT.set(journal)
    try:
        yield journal
    except (DataError, ModelError):
        journal.end()
        raise
    finally:
        _CURRENT.reset(token)
    journal.end()


def answers(
    questions: Sequence[object], work: Work[T], whole: type[T], parts: Kinds = ()
) -> list[T]:
    """The answer to every question, in order: those that the journal of the work around it has,
    from there, the others by `work`, each kept as soon as it is found. Questions are plain values
    or dataclasses of them; an answer is a `whole`, made of `parts`, plain values and arrays of
    float64."""
    if (journal := _CURRENT.get()) is not None:
        return journal.answers(questions, work, whole, parts)
    found = dict(work(range(len(questions))))
    return [found[k] for k in range(len(questions))]


@contextlib.contextmanager
def apart(name: str) -> Iterator[None]:
    """Answers within are those of this name, whatever was asked before: work that is done once, for
    whoever needs it first."""
    journal = _CURRENT.get()
    with contextlib.nullcontext() if journal is None else journal.apart(name):
        yield


def spared() -> float:
    """Seconds that earlier runs took for what this one took from its journal."""
    journal = _CURRENT.get()
    return 0.0 if journal is None else journal.spared


def fits(count: int) -> str:
    """So many fits, in words."""
    return f"{count} fit{'s' * (count != 1)}"


def _differing(one: Mapping[str, object], other: Mapping[str, object]) -> str:
    """Names of what is not the same in both."""
    names = [str(n) for n in {**one, **other} if one.get(n) != other.get(n)]
    more = [f"{len(names) - NAMES} more"] if len(names) > NAMES else []
    return ", ".join([*names[:NAMES], *more])


def _sha(value: object) -> str:
    return hashlib.sha256(json.dumps(value, separators=(",", ":")).encode()).hexdigest()


def plain(value: object) -> Json:
    """A value for JSON that `restored` makes again, to the last bit; a number of NumPy is one of
    Python afterwards. Raises `TypeError`."""
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else {"float": repr(float(value))}
    if value is None or isinstance(value, (bool, int, str)):
        return value
    if isinstance(value, np.ndarray) and value.dtype == np.float64:
        square = value.ndim == 2 and value.shape[0] == value.shape[1]
        if square and value.tobytes() == value.T.tobytes():
            return {"symmetric": [len(value), _text(value[np.tril_indices(len(value))])]}
        return {"array": [list(value.shape), _text(value)]}
    if isinstance(value, tuple):
        return [plain(v) for v in value]
    if isinstance(value, list):
        return {"list": [plain(v) for v in value]}
    if isinstance(value, frozenset):
        return {"frozenset": sorted((plain(v) for v in value), key=json.dumps)}
    if isinstance(value, Mapping):
        return {"dict": [[plain(k), plain(v)] for k, v in value.items()]}
    if isinstance(value, enum.Enum):
        return {type(value).__name__: value.name}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {type(value).__name__: [plain(getattr(value, n)) for n in _given_to(type(value))]}
    raise TypeError(f"a journal keeps no {type(value).__name__}")


def restored(content: Json, kinds: Mapping[str, Kind]) -> object:
    """The value that `plain` made this of. Raises `KeyError`, `TypeError`, `ValueError` for
    anything else."""
    if isinstance(content, list):
        return tuple(restored(v, kinds) for v in content)
    if not isinstance(content, dict):
        return content
    ((name, inner),) = content.items()
    if name == "float":
        return float(inner)
    if name == "array":
        return _numbers(inner[1]).reshape(inner[0])
    if name == "symmetric":
        size, text = inner
        lower = np.zeros((size, size))
        lower[np.tril_indices(size)] = _numbers(text)
        return np.where(np.tri(size, dtype=bool), lower, lower.T)
    if name in CONTAINERS:
        return CONTAINERS[name](restored(v, kinds) for v in inner)
    kind = kinds[name]
    if issubclass(kind, enum.Enum):
        return kind[inner]
    values = [restored(v, kinds) for v in inner]
    return kind(**dict(zip(_given_to(kind), values, strict=True)))


def _given_to(kind: type[DataclassInstance]) -> list[str]:
    """Fields that a dataclass is made with."""
    return [f.name for f in dataclasses.fields(kind) if f.init]


def _text(numbers: npt.NDArray[np.float64]) -> str:
    return base64.b64encode(np.ascontiguousarray(numbers, dtype="<f8").tobytes()).decode()


def _numbers(text: str) -> npt.NDArray[np.float64]:
    raw = np.frombuffer(base64.b64decode(text, validate=True), dtype="<f8")
    return raw.astype(np.float64)
