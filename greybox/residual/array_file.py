"""Numbers on disk: one JSON file with a schema and a checksum, and the large arrays beside it
(same stem, .npz).

Numbers only: nothing in either file is executed.
"""

from __future__ import annotations

import io
import os
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt

from greybox.errors import FileFormatError
from greybox.files import Parsed, checksum, read_json, to_plain, write_atomic, write_json
from greybox.symbolic import FloatArray

LARGEST_ARRAYS = 500 * 2**20
"""Bytes of the arrays of one file as doubles: six outputs of 1000 support points take 48 MB."""
UNREADABLE: tuple[type[Exception], ...] = (
    *(OSError, ValueError, KeyError, EOFError, AttributeError, TypeError, RuntimeError),
    *(MemoryError, zipfile.BadZipFile, zlib.error),
)
"""What NumPy and zipfile raise for an archive that is damaged, encrypted, or none at all."""


def write_with_arrays(
    path: str | os.PathLike[str],
    schema: str,
    plain: Mapping[str, object],
    arrays: Mapping[str, FloatArray],
) -> Path:
    """Write `plain` to `path` and `arrays` beside it, each atomically. Returns the path."""
    target = Path(path)
    beside = target.with_suffix(".npz")
    body = {
        "schema": schema,
        **to_plain(dict(plain)),
        "arrays": beside.name,
        "arrays_sha256": _digest(arrays),
    }
    write_atomic(beside, packed(arrays))
    return write_json(target, {**body, "checksum": checksum(body)})


def packed(arrays: Mapping[str, npt.NDArray[np.generic]], *, compressed: bool = False) -> bytes:
    """The bytes of an .npz file."""
    buffer = io.BytesIO()
    write = np.savez_compressed if compressed else np.savez
    write(buffer, **arrays)  # type: ignore[arg-type]
    return buffer.getvalue()


def read_with_arrays(
    path: str | os.PathLike[str], schema: str
) -> tuple[Parsed, dict[str, FloatArray]]:
    """What `write_with_arrays` wrote. Raises `FileFormatError` (schema, checksum, missing or
    foreign arrays)."""
    where = str(path)
    body = read_json(path, schema=schema)
    if body.pop("checksum", None) != checksum(body):
        raise FileFormatError(
            "the checksum does not match",
            where=where,
            fix="the file was edited or is damaged; write it again",
        )
    beside = Path(path).parent / Path(str(body.get("arrays"))).name
    arrays = load_arrays(beside)
    if _digest(arrays) != body.get("arrays_sha256"):
        raise FileFormatError(
            "these are not the arrays of that file",
            where=str(beside),
            fix="copy both files together",
        )
    return body, arrays


def load_arrays(path: str | os.PathLike[str]) -> dict[str, FloatArray]:
    """All arrays of an .npz file. Raises `FileFormatError` for one that cannot be read, holds more
    than numbers, or unpacks to more than `LARGEST_ARRAYS`."""
    where, fix = str(path), "keep the .npz beside its .json"
    if not Path(path).is_file():
        raise FileFormatError("no such file of arrays", where=where, fix=fix)
    try:
        with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as stored:
            size = sum(entry.file_size for entry in stored.zip.infolist())
            arrays: dict[str, FloatArray] = {}
            for name in stored.files:
                if size > LARGEST_ARRAYS:
                    break
                array = stored[name]
                # a byte of a small type becomes eight
                size += 8 * array.size - array.nbytes
                if size <= LARGEST_ARRAYS:
                    arrays[name] = np.asarray(array, dtype=np.float64)
            if size > LARGEST_ARRAYS:
                message = f"the arrays unpack to more than {LARGEST_ARRAYS / 2**20:g} MiB"
                raise FileFormatError(message, where=where, fix="pass a file that greybox wrote")
            return arrays
    except FileFormatError:
        raise
    except UNREADABLE as error:
        message = f"cannot read the arrays ({error})"
        raise FileFormatError(message, where=where, fix=fix) from None


def _digest(arrays: Mapping[str, FloatArray]) -> str:
    parts = {n: [list(a.shape), np.ascontiguousarray(a).tobytes().hex()] for n, a in arrays.items()}
    return checksum(dict(sorted(parts.items())))
