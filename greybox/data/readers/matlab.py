"""MATLAB files up to version 7.2 by scipy: vectors of one length, also inside structs, as one table of columns.

A matrix (N, K) becomes columns name[0]..name[K-1]; the field `gyro` of a struct `imu` becomes `imu.gyro`. Of vectors of
several lengths those as long as the time are taken. Version 7.3 (HDF5) and objects (timeseries, tables) are not read.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from greybox.data.logs.table import Table
from greybox.data.readers.recording import LogFormat, checked_file, damaged
from greybox.errors import DataError

_MAGIC = b"MATLAB 5.0 MAT-file"
_HDF = b"MATLAB 7.3 MAT-file"
_TIMES = ("t", "time", "timestamp", "tout", "time_s", "time_ms", "time_us")
WIDEST = 32
"""A matrix with more columns than this is no set of channels."""


def read_mat(path: str | os.PathLike[str]) -> Table:
    """Read a MAT file. Raises `DataError` where it is damaged, of version 7.3, or holds no vectors of one length."""
    where = os.fspath(path)
    digest = checked_file(Path(path))
    with Path(path).open("rb") as stream:
        if stream.read(len(_HDF)) == _HDF:
            raise DataError("a MAT file of version 7.3 (HDF5)", where=where, fix="in MATLAB: save(name, '-v7')")
    with damaged(where, "a MAT file"):
        from scipy.io import loadmat

        content = loadmat(where, squeeze_me=True, struct_as_record=False, chars_as_strings=True)
        vectors = dict(_vectors({k: v for k, v in content.items() if not k.startswith("__")}, "", 0))
    lengths = [v.size for v in vectors.values() if v.size > 1]
    if not lengths:
        raise DataError(
            "no numeric vectors", where=where, got=", ".join(k for k in content if not k.startswith("__"))[:80] or "nothing",
            fix="save plain vectors or structs of them (timeseries and table objects cannot be read)",
        )  # fmt: skip
    times = [k for k, v in vectors.items() if k.rpartition(".")[2].lower() in _TIMES and v.size > 1]
    n = max((vectors[k].size for k in times), default=max(set(lengths), key=lengths.count))
    columns: dict[str, npt.NDArray[Any]] = {k: v for k, v in vectors.items() if v.size == n}
    # A time inside a struct is the time of the table where no plain one is there.
    if times and not any(k.lower() in _TIMES for k in columns):
        own = next(k for k in times if vectors[k].size == n)
        columns.setdefault(own.rpartition(".")[2], vectors[own])
    left = [k for k, v in vectors.items() if v.size not in (n, 1)]
    notes = (f"left out, not as long as the time ({n}): {', '.join(left[:12])}",) if left else ()
    return Table(
        columns=columns,
        rows=np.arange(1, n + 1, dtype=np.int64),
        source=Path(path).name,
        sha256=digest,
        notes=notes,
    )


def _vectors(values: dict[str, Any], prefix: str, depth: int) -> Iterator[tuple[str, npt.NDArray[np.float64]]]:
    """Name and numbers of every vector and matrix, those inside structs under dotted names."""
    for name, value in values.items():
        full = prefix + name
        if hasattr(value, "_fieldnames"):
            if depth < 4:
                yield from _vectors({f: getattr(value, f) for f in value._fieldnames}, full + ".", depth + 1)
            continue
        array = np.asarray(value)
        if array.dtype.kind not in "fiub":
            continue
        if array.ndim <= 1:
            yield full, np.atleast_1d(array).astype(np.float64)
        elif array.ndim == 2:
            matrix = (array if array.shape[0] >= array.shape[1] else array.T).astype(np.float64)
            if matrix.shape[1] <= WIDEST:
                for j in range(matrix.shape[1]):
                    yield f"{full}[{j}]", np.ascontiguousarray(matrix[:, j])


FORMAT = LogFormat(
    name="matlab",
    title="MATLAB (up to version 7.2)",
    endings=(".mat",),
    recognise=lambda path, head: head.startswith((_MAGIC, _HDF)),
    table=read_mat,
    advice={"": "save one vector or matrix per sensor and a vector `t` [s] of the same length; save(name, '-v7')"},
)
