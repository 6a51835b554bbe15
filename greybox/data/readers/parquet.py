"""Apache Parquet files by pyarrow: one table of columns, as a CSV file."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from greybox.data.logs.table import Table
from greybox.data.memory import allowance
from greybox.data.raw import Column
from greybox.data.readers.recording import LogFormat, checked_file, damaged, library
from greybox.errors import DataError

if TYPE_CHECKING:
    import pyarrow

_MAGIC = b"PAR1"


def read_parquet(path: str | os.PathLike[str]) -> Table:
    """Read a Parquet file: numbers as float64 (null = missing), times in seconds, anything else as
    text.

    Of structs every field becomes a column, gyro.x; columns of lists become one column per entry
    where all rows have equally many. Raises `DataError`.
    """
    where = os.fspath(path)
    digest = checked_file(Path(path))
    library("pyarrow", where=where, what="a Parquet file")
    parquet = library("pyarrow.parquet", where=where, what="a Parquet file")
    with damaged(where, "a Parquet file"):
        said = parquet.read_metadata(where)
        if said.num_rows * said.num_columns * np.dtype(float).itemsize > allowance(where):
            raise MemoryError
        # A thread that reads ahead would end the process where memory is short: nobody can catch
        # what it throws.
        content = parquet.read_table(where, memory_map=False, use_threads=False, pre_buffer=False)
        while any(str(f.type).startswith("struct") for f in content.schema):
            content = content.flatten()
        columns: dict[str, Column] = {}
        for name, column in zip(content.column_names, content.columns, strict=True):
            columns.update(_column(str(name), column))
        timed = frozenset(
            str(f.name) for f in content.schema if str(f.type).startswith("timestamp")
        )
        n = content.num_rows
    if n == 0 or not columns:
        raise DataError("a table without rows", where=where, fix="export the log again")
    rows = np.arange(1, n + 1, dtype=np.int64)
    return Table(columns=columns, rows=rows, source=Path(path).name, sha256=digest, seconds=timed)


def _column(name: str, column: pyarrow.ChunkedArray) -> dict[str, Column]:
    import pyarrow as pa

    kind = column.type
    if pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind):
        rows = column.to_pylist()
        width = len(rows[0]) if rows and rows[0] is not None else 0
        if 0 < width <= 16 and all(r is not None and len(r) == width for r in rows):
            try:
                matrix = np.array(
                    [[np.nan if v is None else v for v in r] for r in rows], dtype=np.float64
                )
            except (TypeError, ValueError):
                return {name: np.array([str(r) for r in rows], dtype=np.str_)}
            return {f"{name}[{j}]": np.ascontiguousarray(matrix[:, j]) for j in range(width)}
        return {name: np.array([str(r) for r in rows], dtype=np.str_)}
    if pa.types.is_temporal(kind):
        nanoseconds = np.array(
            column.to_numpy(), dtype="datetime64[ns]" if pa.types.is_timestamp(kind) else None
        )
        if nanoseconds.dtype.kind == "M":
            seconds = nanoseconds.astype(np.int64) * 1e-9
            return {name: np.where(np.isnat(nanoseconds), np.nan, seconds)}
        return {name: np.array([str(v) for v in column.to_pylist()], dtype=np.str_)}
    if pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind):
        values = (
            column.to_pylist()
            if pa.types.is_boolean(kind)
            else column.cast(pa.float64(), safe=False).to_numpy()
        )
        return {
            name: np.array([np.nan if v is None else v for v in values], dtype=np.float64)
            if isinstance(values, list)
            else np.array(values, dtype=np.float64)
        }
    return {
        name: np.array(["" if v is None else str(v) for v in column.to_pylist()], dtype=np.str_)
    }


FORMAT = LogFormat(
    name="parquet",
    title="Apache Parquet",
    endings=(".parquet", ".pq"),
    recognise=lambda path, head: head.startswith(_MAGIC),
    table=read_parquet,
    libraries=("pyarrow",),
    advice={
        "": "columns have the names, units and frames of docs/files.md, or a mapping file says "
        "which they are"
    },
)
