"""Table: a log file as it came, under its own column names."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from greybox.data.raw import Column
from greybox.errors import DataError, printable


@dataclass(frozen=True, kw_only=True, eq=False)
class Table:
    """Columns of one file under their own names: float64 (NaN = empty cell), or text where a cell
    is not a number.

    `rows` (N,) are the line numbers in the file, for messages. `canonical` tables are in channels,
    units and frames of the contract already; `noncausal` and `notes` are then the reader's, and
    `origins` maps channels to the columns of the file, where that is one table, and `recipes` to
    how they were made of what it holds. `seconds` names the
    columns whose type says that they are times.
    """

    columns: Mapping[str, Column]
    rows: npt.NDArray[np.int64]
    source: str
    sha256: str
    canonical: bool = False
    noncausal: frozenset[str] = frozenset()
    notes: tuple[str, ...] = ()
    origins: Mapping[str, str] = field(default_factory=dict)
    recipes: Mapping[str, str] = field(default_factory=dict)
    seconds: frozenset[str] = frozenset()


def text_error(table: Table, column: str, name: str) -> DataError:
    """The error of a column that holds text and is needed as `name`."""
    row, cell = _first_text(table, table.columns[column])
    return DataError(
        f"'{cell}' is not a number",
        where=f"{table.source}, row {row}, column '{column}' ({name})",
        fix="leave the cell empty where the value is missing",
    )


def _first_text(table: Table, column: Column) -> tuple[int, str]:
    for row, cell in zip(table.rows, column, strict=True):
        try:
            float(str(cell) or "nan")
        except ValueError:
            text = str(cell)
            return int(row), text if len(text) <= 30 else text[:27] + "..."
    raise AssertionError("a text column without text")


def flight_name(path: str | Path) -> str:
    """Name of the flight of a log file: the file name without .csv or .csv.gz (or its last
    suffix)."""
    name = printable(Path(path).name)  # it is printed, and a name of a file may hold anything
    if name.endswith(".gz"):
        name = name[: -len(".gz")]
    stem, dot, _ = name.rpartition(".")
    return stem if dot and stem else name
