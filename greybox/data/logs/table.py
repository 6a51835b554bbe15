"""Table: a log file as it came, under its own column names."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from greybox.errors import printable


@dataclass(frozen=True, kw_only=True, eq=False)
class Table:
    """Columns of one file under their own names: float64 (NaN = empty cell), or text where a cell is not a number.

    `rows` (N,) are the line numbers in the file, for messages. `canonical` tables are in channels, units and frames of
    the contract already, so that a vehicle's `[columns]` do not apply; `noncausal` and `notes` are then the reader's.
    """

    columns: Mapping[str, npt.NDArray[Any]]
    rows: npt.NDArray[np.int64]
    source: str
    sha256: str
    canonical: bool = False
    noncausal: frozenset[str] = frozenset()
    notes: tuple[str, ...] = ()


def flight_name(path: str | Path) -> str:
    """Name of the flight of a log file: the file name without .csv or .csv.gz (or its last suffix)."""
    name = printable(Path(path).name)  # it is printed, and a name of a file may hold anything
    if name.endswith(".gz"):
        name = name[: -len(".gz")]
    stem, dot, _ = name.rpartition(".")
    return stem if dot and stem else name
