"""MATLAB files up to version 7.2 by scipy: vectors of one length, also inside structs, as one table
of columns.

A matrix (N, K) becomes columns name[0]..name[K-1]; the field `gyro` of a struct `imu` becomes
`imu.gyro`. Of vectors of several lengths those as long as the time are taken. Version 7.3 (HDF5)
and objects (timeseries, tables) are not read.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from greybox.data.logs.table import Table
from greybox.data.memory import allowance
from greybox.data.raw import Column, FloatArray
from greybox.data.readers.recording import LogFormat, checked_file
from greybox.errors import DataError

_MAGIC = b"MATLAB 5.0 MAT-file"
_HDF = b"MATLAB 7.3 MAT-file"
_TIMES = ("t", "time", "timestamp", "timestamps", "tout", "time_s", "time_ms", "time_us")
TIME_LIMIT = 300
"""Seconds that reading one file may take."""


def read_mat(path: str | os.PathLike[str]) -> Table:
    """Read a MAT file. Raises `DataError` where it is damaged, of version 7.3, or holds no vectors
    of one length."""
    where = os.fspath(path)
    digest = checked_file(Path(path))
    with Path(path).open("rb") as stream:
        if stream.read(len(_HDF)) == _HDF:
            raise DataError(
                "a MAT file of version 7.3 (HDF5)", where=where, fix="in MATLAB: save(name, '-v7')"
            )
    return table_of(*_read_apart(where), where=where, sha256=digest)


def table_of(
    vectors: Mapping[str, FloatArray], variables: Sequence[str], *, where: str, sha256: str
) -> Table:
    """The vectors as long as the time, else those of the most usual length, as one table;
    `variables` are the names of all that the file holds. Raises `DataError` where no vector is."""
    lengths = [v.size for v in vectors.values() if v.size > 1]
    if not lengths:
        raise DataError(
            "no numeric vectors",
            where=where,
            got=", ".join(variables)[:80] or "nothing",
            fix="save plain vectors or structs of them (timeseries and table objects cannot be "
            "read)",
        )
    times = [k for k, v in vectors.items() if k.rpartition(".")[2].lower() in _TIMES and v.size > 1]
    n = max((vectors[k].size for k in times), default=max(lengths, key=lengths.count))
    columns: dict[str, Column] = {k: v for k, v in vectors.items() if v.size == n}
    # A time inside a struct is the time of the table where no plain one is there.
    if times and not any(k.lower() in _TIMES for k in columns):
        own = next(k for k in times if vectors[k].size == n)
        columns.setdefault(own.rpartition(".")[2], vectors[own])
    left = [k for k, v in vectors.items() if v.size not in (n, 1)]
    notes = (f"left out, not as long as the time ({n}): {', '.join(left[:12])}",) if left else ()
    return Table(
        columns=columns,
        rows=np.arange(1, n + 1, dtype=np.int64),
        source=Path(where).name,
        sha256=sha256,
        notes=notes,
    )


def _read_apart(where: str) -> tuple[dict[str, npt.NDArray[np.float64]], list[str]]:
    """(vectors by name, names of all variables), read in another process, because scipy can crash
    on damaged files."""
    script = Path(__file__).with_name("mat_child.py")
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "vectors.npz"
        try:
            done = subprocess.run(
                [
                    sys.executable,
                    "-P",
                    str(script),
                    os.path.abspath(where),
                    str(target),
                    str(allowance(where)),
                ],
                capture_output=True,
                text=True,
                encoding="utf-8",
                errors="replace",
                timeout=TIME_LIMIT,
                check=False,
                stdin=subprocess.DEVNULL,
            )
        except OSError as error:
            raise DataError(f"no process to read it in: {error.strerror}", where=where) from None
        except subprocess.TimeoutExpired:
            raise DataError(
                f"not read within {TIME_LIMIT} s", where=where, fix="save fewer variables"
            ) from None
        if done.returncode != 0 or not target.exists():
            said = done.stderr.strip().splitlines()[-1:] if done.returncode == 1 else []
            why = said[0] if said else "its reader crashed on it"
            raise DataError(
                f"cannot be read as a MAT file ({why})", where=where, fix="save or copy it again"
            )
        with np.load(target, allow_pickle=False) as content:
            names = json.loads(bytes(content["names"]).decode())
            vectors = {
                n: np.asarray(content[f"v{i}"], dtype=np.float64)
                for i, n in enumerate(names["vectors"])
            }
    return vectors, list(names["variables"])


FORMAT = LogFormat(
    name="matlab",
    title="MATLAB (up to version 7.2)",
    endings=(".mat",),
    recognise=lambda path, head: head.startswith((_MAGIC, _HDF)),
    table=read_mat,
    advice={
        "": "save one vector or matrix per sensor and a vector `t` [s] of the same length; "
        "save(name, '-v7')"
    },
)
