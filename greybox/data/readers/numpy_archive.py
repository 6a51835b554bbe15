"""NumPy archives (.npz): arrays of one length as one table, a matrix (N, K) as K columns, of
(N, 3, 3) nine row by row."""

from __future__ import annotations

import os
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from greybox.data.logs.table import Table
from greybox.data.memory import allowance
from greybox.data.raw import FloatArray
from greybox.data.readers.matlab import table_of
from greybox.data.readers.recording import LogFormat, checked_file, damaged

_ZIP = b"PK\x03\x04"
_WIDEST = 16
"""Columns of a matrix that are channels, and no image."""


def read_npz(path: str | os.PathLike[str]) -> Table:
    """Read an archive. Raises `DataError` where it is damaged or holds no vectors of one length;
    objects are not unpickled."""
    where = os.fspath(path)
    digest = checked_file(Path(path))
    vectors: dict[str, FloatArray] = {}
    with damaged(where, "a NumPy archive"), zipfile.ZipFile(where) as packed:
        if sum(entry.file_size for entry in packed.infolist()) > allowance(where):
            raise MemoryError
    with (
        damaged(where, "a NumPy archive"),
        Path(path).open("rb") as stream,
        np.load(stream, allow_pickle=False) as content,
    ):
        names = [n for n in content.files if f"{n}.npy" in content.zip.namelist()]
        left: list[str] = []
        for name in names:
            try:
                array = content[name]
            except ValueError:  # of objects
                left.append(name)
                continue
            width = int(np.prod(array.shape[1:]))
            if array.dtype.kind not in "fiub" or not array.ndim or not 0 < width <= _WIDEST:
                left += [name] if array.ndim else []
                continue
            matrix = array.reshape(len(array), width).astype(np.float64)
            if width == 1:
                vectors[name] = matrix[:, 0]
            else:
                vectors |= {f"{name}[{j}]": matrix[:, j] for j in range(width)}
    table = table_of(vectors, names, where=where, sha256=digest)
    said = f"left out, no numbers or more than {_WIDEST} a row: {', '.join(left[:12])}"
    return replace(table, notes=(*table.notes, said)) if left else table


def _first_entry(head: bytes) -> bytes:
    """The name of the first entry of a ZIP archive that begins with these bytes."""
    return head[30 : 30 + int.from_bytes(head[26:28], "little")]


FORMAT = LogFormat(
    name="numpy",
    title="NumPy archive",
    endings=(".npz",),
    recognise=lambda path, head: head.startswith(_ZIP) and _first_entry(head).endswith(b".npy"),
    table=read_npz,
    advice={"": "np.savez one array (N, K) per sensor and a vector t [s] of N"},
)
