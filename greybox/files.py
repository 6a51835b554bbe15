"""Files that are never half-written: atomic writes, checksums, and JSON that other tools can read.

JSON has no NaN or infinity, so that these are written as null.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import itertools
import json
import math
import os
import tempfile
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from greybox.errors import FileFormatError, GreyboxError

Json: TypeAlias = "bool | int | float | str | Sequence[Json] | Mapping[str, Json] | None"
"""Any value of a JSON file. A document that greybox itself reads again has a TypedDict of its own
where it is made."""
Parsed: TypeAlias = Mapping[str, Any]
"""An object of a JSON or TOML file as its parser gave it, of which nothing is checked yet: whoever
reads it asks or catches KeyError, TypeError and ValueError."""
LARGEST_JSON = 128 * 2**20
"""Bytes of a JSON file that is read; the model of 1000 support points and six outputs has about 120
MB."""
MOST_CONTAINERS, MOST_QUOTES = 300_000, 4_000_000
"""Arrays and objects, and quotation marks, of a JSON file: they cost more memory than their
characters suggest."""
MALFORMED = (KeyError, TypeError, ValueError, IndexError, AttributeError, ArithmeticError)
"""What is raised where content of another shape than expected is made a value of."""
OTHER_VERSION = "wrong schema: written by another version of greybox"
OTHER_FIX = "use that version, or make the file again with this one"
LEFT_BY_BROWSERS = {".DS_Store", "Thumbs.db"}
"""Files that looking into a folder leaves there, and makes again: nobody's work."""
LARGEST_TOML, MOST_DOTS = 2**18, 200
"""Bytes of a TOML file, and dots in one line of it: the cost of a dotted key grows with its
square."""


class OutputError(GreyboxError, OSError):
    """A result cannot be written where it was asked for."""


def write_atomic(path: str | os.PathLike[str], content: str | bytes) -> Path:
    """Write `content` so that at any moment either the old or the new file is there. Returns the
    path.

    Parent folders are made. A device or a pipe is written to as it is. Raises `OutputError` (disk
    full, read-only folder, a folder of that name).
    """
    target = Path(path)
    data = content.encode() if isinstance(content, str) else content
    temporary = None
    try:
        if target.exists() and not target.is_file() and not target.is_dir():
            target.write_bytes(data)
            return target
        target.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(
            dir=target.parent, prefix=f".{target.name}.", suffix=".part"
        )
        with os.fdopen(handle, "wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        mask = os.umask(0)
        os.umask(mask)
        os.chmod(temporary, 0o666 & ~mask)
        os.replace(temporary, target)
    except OSError as error:
        raise OutputError(
            f"cannot write: {error.strerror or error}",
            where=str(target),
            fix="choose another --out",
        ) from None
    finally:
        if temporary is not None and os.path.exists(temporary):
            with contextlib.suppress(OSError):
                os.unlink(temporary)
    return target


def no_overwriting(path: str | os.PathLike[str], option: str, *, force: bool) -> None:
    """Refuse a file that is there already, which may have been edited by hand. Raises
    `OutputError`."""
    if Path(path).is_file() and not force:
        raise OutputError(
            "the file exists", where=os.fspath(path), fix=f"choose another {option}, or add --force"
        )


def empty(folder: Path) -> bool:
    """Whether a folder holds nothing, or what a file browser leaves there."""
    return all(p.name in LEFT_BY_BROWSERS and p.is_file() for p in folder.iterdir())


def own_place(
    folder: str | os.PathLike[str],
    record: str,
    schema: str,
    what: str,
    *,
    fix: str = "choose another --out",
) -> None:
    """Refuse a folder for many files that is neither free, nor empty (also through a link), nor
    holds the file `record` of `schema`, by which a folder of `what` ("a bundle") is known. Raises
    `OutputError`."""
    place = Path(folder)
    if not os.path.lexists(place):
        return
    if not place.is_dir():
        raise OutputError("not a folder", where=str(place), fix="choose another --out")
    if empty(place):
        return
    if place.is_symlink():
        raise OutputError(
            "a link to a folder with files, not a folder itself",
            where=str(place),
            fix="name the folder it leads to, or choose another --out",
        )
    if not _is_of(place / record, schema):
        raise OutputError(f"the folder holds something else than {what}", where=str(place), fix=fix)


def _is_of(path: Path, schema: str) -> bool:
    """Whether a path is a file of the schema; a pipe of its name would never end."""
    try:
        return path.is_file() and read_json(path).get("schema") == schema
    except FileFormatError:
        return False


def withdraw(folder: str | os.PathLike[str], *names: str) -> None:
    """Remove results of an earlier run before the first of this run is written.

    A run that is killed then leaves no page of other numbers beside its own.
    """
    for name in names:
        with contextlib.suppress(OSError):
            (Path(folder) / name).unlink()


def set_aside(path: Path) -> Path:
    """The file, of an earlier search and perhaps edited since, under the first free name F.old,
    F.old2, ..."""
    names = (path.with_name(f"{path.name}.old{n if n > 1 else ''}") for n in itertools.count(1))
    return path.replace(next(name for name in names if not name.exists()))


def check_writable(path: str | os.PathLike[str], *, folder: bool = False) -> None:
    """Whether a file can be written at `path` (in it, if it is to be a `folder`): said before hours
    of work, not after.

    Nothing is made. Raises `OutputError` (disk full, read-only folder, a file where a folder should
    be, or the reverse).
    """
    place = Path(path)
    if not os.fspath(path):  # that of a variable of the shell that is not set, and no "."
        raise OutputError("no name of a file or folder", got="''", fix="choose another --out")
    try:
        if folder and place.exists() and not place.is_dir():
            raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR))
        if not folder and place.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        while not place.exists():
            place = place.parent
        if place == Path(path) and not place.is_dir():
            if place.is_file() and not os.access(place.parent, os.W_OK):
                raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
            return
        with tempfile.TemporaryFile(dir=place) as probe:
            probe.write(b"greybox")
            probe.flush()
    except OSError as error:
        raise OutputError(
            f"cannot write: {error.strerror or error}", where=str(path), fix="choose another --out"
        ) from None


@contextlib.contextmanager
def sole_writer(folder: str | os.PathLike[str]) -> Iterator[None]:
    """Nobody else writes results into `folder` inside: files of two runs would stand side by side.

    The folder is made, and removed again where nothing came into it. The lock ends with the
    process, also by kill -9 (flock; where there is none, nothing is locked). Raises `OutputError`.
    """
    place = Path(folder)
    made = [p for p in (place, *place.parents) if not p.exists()]
    handle = _locked(place)
    try:
        yield
    finally:
        if handle is not None:
            os.close(handle)
        with contextlib.suppress(OSError):
            for empty in made:
                empty.rmdir()


def _locked(place: Path) -> int | None:
    """Handle of a folder that this process locked; None where folders cannot be locked."""
    try:
        import fcntl

        place.mkdir(parents=True, exist_ok=True)
        handle = os.open(place, os.O_RDONLY)
    except (ImportError, OSError):
        return None
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        message, fix = (
            "another greybox command writes into this folder",
            "wait for it, or choose another --out",
        )
        raise OutputError(message, where=str(place), fix=fix) from None
    except OSError:
        os.close(handle)
        return None
    return handle


@contextlib.contextmanager
def well_formed(where: str, fix: str = "write the file again") -> Iterator[None]:
    """Around what makes a value of the content of the file `where`: content of another shape than
    expected is a `FileFormatError`. What greybox itself raises there stays as it is."""
    try:
        yield
    except GreyboxError:
        raise
    except MALFORMED as error:
        raise FileFormatError(f"incomplete or wrong ({error})", where=where, fix=fix) from None


def to_plain(value: object) -> Any:
    """Turn NumPy scalars and arrays, tuples, sets and paths into plain JSON values; NaN and
    infinity become None."""
    if isinstance(value, dict):
        return {str(k): to_plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        return [to_plain(v) for v in value]
    if isinstance(value, np.ndarray):
        return to_plain(value.tolist())
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, (int, np.integer)):
        return int(value)
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Path):
        return str(value)
    return value


def dump_json(value: object, *, indent: int | None = 1) -> str:
    """JSON text with plain numbers, one trailing newline, keys in the order given."""
    return json.dumps(to_plain(value), indent=indent, allow_nan=False) + "\n"


def write_json(path: str | os.PathLike[str], value: object) -> Path:
    """`dump_json`, written atomically."""
    return write_atomic(path, dump_json(value))


READERS = {
    ".toml": "greybox.read_vehicle reads a vehicle file",
    ".csv": "greybox.read_logs reads logs",
}
"""What to do with a file that is no JSON, by how its name ends."""


def read_json(path: str | os.PathLike[str], *, schema: str | None = None) -> Any:
    """Read a JSON object, whose shape the caller names; with `schema` also demand that its "schema"
    field is that string.

    Raises `FileFormatError` for a missing file, text that is not JSON, a file over the limits of
    this module, or another schema.
    """
    where = str(path)
    try:
        content = read_limited(path, LARGEST_JSON)
        if (
            content.count(b"[") + content.count(b"{") > MOST_CONTAINERS
            or content.count(b'"') > MOST_QUOTES
        ):
            raise FileFormatError(
                "too many arrays, objects or texts",
                where=where,
                fix="pass a file that greybox wrote",
            )
        value = json.loads(content)
        if b"\\ud" in content.lower():
            json.dumps(
                value, ensure_ascii=False
            ).encode()  # half of a pair is no text that could be written again
    except FileNotFoundError:
        raise FileFormatError("no such file", where=where, fix="check the path") from None
    except IsADirectoryError:
        raise FileFormatError(
            "a folder, not a file", where=where, fix=_instead(Path(path), schema)
        ) from None
    except OSError as error:
        raise FileFormatError(f"cannot read: {error.strerror}", where=where) from None
    except (ValueError, RecursionError) as error:
        raise FileFormatError(
            f"not JSON ({error})",
            where=where,
            fix=READERS.get(Path(path).suffix, "pass a file that greybox wrote"),
        ) from None
    except MemoryError:
        raise FileFormatError(
            "too large for the memory", where=where, fix="pass a file that greybox wrote"
        ) from None
    if not isinstance(value, dict):
        raise FileFormatError("not a JSON object", where=where, got=type(value).__name__)
    if schema is not None and value.get("schema") != schema:
        other = of_another_version(value.get("schema"), schema)
        raise FileFormatError(
            OTHER_VERSION if other else "wrong schema",
            where=where,
            expected=schema,
            got=repr(value.get("schema")),
            fix=OTHER_FIX if other else _instead(Path(path).parent, schema),
        )
    return value


def read_toml(
    path: str | os.PathLike[str],
    *,
    what: str,
    error: type[GreyboxError],
    largest: int = LARGEST_TOML,
) -> dict[str, Any]:
    """Read the TOML of a stranger; `what` it is meant to be ("vehicle file").

    Raises `error` for a missing file, text that is not TOML, nested too deeply, or over the limits
    of this module.
    """
    where = str(path)
    try:
        text = read_limited(path, largest).decode("utf-8-sig").replace("\r\n", "\n")
        if any(line.count(".") > MOST_DOTS for line in text.split("\n")):
            fix = "give one value a line"
            raise error(f"a line with more than {MOST_DOTS} dots", where=where, fix=fix)
        return tomllib.loads(text)
    except FileFormatError:
        message = f"more than {largest // 1024} KiB"
        raise error(message, where=where, fix=f"pass a {what}, not a log") from None
    except FileNotFoundError:
        raise error(f"no such {what}", where=where, fix="check the path") from None
    except IsADirectoryError:
        fix = "pass the .toml file in it"
        raise error(f"a folder, not a {what}", where=where, fix=fix) from None
    except UnicodeDecodeError:
        fix = "pass a TOML file saved as UTF-8"
        raise error("not a text file", where=where, fix=fix) from None
    except OSError as cause:
        message = f"cannot read: {cause.strerror or cause}"
        raise error(message, where=where, fix="check the path") from None
    except RecursionError:
        fix = f"pass a {what}"
        raise error("not valid TOML: nested too deeply", where=where, fix=fix) from None
    except ValueError as cause:  # besides its own, tomllib lets those of numbers and dates through
        if isinstance(cause, error):
            raise
        fix = "correct the line that is named"
        raise error(f"not valid TOML: {cause}", where=where, fix=fix) from None


def of_another_version(got: object, *expected: str) -> bool:
    """Whether a schema is that of an expected kind, with another number."""
    kinds = {e.partition("/")[0] for e in expected}
    return isinstance(got, str) and "/" in got and got.partition("/")[0] in kinds


def _instead(folder: Path, schema: str | None) -> str:
    """Which file of a folder to pass: those of the schema, or the JSON files that there are."""
    with contextlib.suppress(OSError):
        files = sorted(p for p in folder.iterdir() if p.suffix == ".json" and p.is_file())[:50]
        named = [p for p in files if schema is not None and _begins_with(p, schema)]
        if named or (files and schema is None):
            return f"pass {' or '.join(str(p) for p in (named or files)[:5])}"
    return "pass a file of that kind"


def _begins_with(path: Path, schema: str) -> bool:
    """Whether a file that greybox wrote is of a schema, which stands first in it."""
    with open(path, "rb") as stream:
        return json.dumps(schema).encode() in stream.read(200)


def read_limited(path: str | os.PathLike[str], limit: int) -> bytes:
    """The bytes of a file or pipe. Raises `FileFormatError` for more than `limit`, `OSError` where
    it cannot be read."""
    with open(path, "rb") as stream:
        # In pieces: the size of a pipe or a device is not known before, and read(limit) would set
        # it all aside.
        pieces, size = [], 0
        while piece := stream.read(1 << 20):
            size += len(piece)
            if size > limit:
                raise FileFormatError(
                    f"more than {limit / 2**20:g} MiB",
                    where=str(path),
                    fix="pass a file that greybox wrote",
                )
            pieces.append(piece)
    return b"".join(pieces)


def checksum(value: object) -> str:
    """SHA-256 of the canonical JSON of a value. Raises `FileFormatError` for one nested too deeply
    for that."""
    try:
        return _checksum(value)
    except RecursionError:
        raise FileFormatError("nested too deeply", fix="pass a file that greybox wrote") from None


def _checksum(value: object) -> str:
    text = json.dumps(to_plain(value), sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def file_sha256(path: str | os.PathLike[str]) -> str:
    """SHA-256 of a file's bytes."""
    digest = hashlib.sha256()
    with open(path, "rb") as stream:
        for block in iter(lambda: stream.read(1 << 20), b""):
            digest.update(block)
    return digest.hexdigest()


def content_sha256(path: str | os.PathLike[str]) -> str:
    """Checksum of a file, or of all files of a folder (ROS bags are folders)."""
    place = Path(path)
    if not place.is_dir():
        return file_sha256(place)
    files = sorted(p for p in place.rglob("*") if p.is_file())
    return checksum([[p.relative_to(place).as_posix(), file_sha256(p)] for p in files])


def append_json_line(path: Path, row: Mapping[str, object], *, synced: bool = True) -> None:
    """Add a row to a file of JSON lines, in one write that is on the disk when this returns (not
    `synced`: that outlives the process, not the machine). A line that was cut off before it stays
    alone."""
    with path.open("ab+") as stream:
        size = stream.seek(0, os.SEEK_END)
        stream.seek(max(0, size - 1))
        whole = stream.read(1) in (b"", b"\n")
        stream.write((("" if whole else "\n") + json.dumps(row) + "\n").encode())
        stream.flush()
        if synced:
            os.fsync(stream.fileno())


def read_json_lines(text: str) -> list[Any]:
    """Rows of a text of JSON lines; a line that was cut off counts as not there."""
    rows = []
    for line in text.splitlines():
        with contextlib.suppress(json.JSONDecodeError):
            rows.append(json.loads(line))
    return rows
