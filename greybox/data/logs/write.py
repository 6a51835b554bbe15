"""Writer of the flight-log contract: canonical channels as CSV, exact to the last digit."""

from __future__ import annotations

import gzip
import os
from pathlib import Path

from greybox.data.raw import FloatArray, RawLog
from greybox.files import write_atomic

BLOCK = 50_000
"""Rows that are turned into text at once: single cells take a hundred bytes each while they
wait."""


def write_csv(path: str | os.PathLike[str], raw: RawLog) -> Path:
    """Write the canonical channels of a log, rows in their order, missing values as empty cells;
    `.gz` compresses.

    Every number reads back as it is. Raises `OutputError`.
    """
    names = [*raw.channels]
    columns = [raw.t, *(raw.channels[n] for n in names)]
    parts = [",".join(["t", *names])]
    for start in range(0, raw.n, BLOCK):
        cells = [_cells(c[start : start + BLOCK]) for c in columns]
        parts.append("\n".join(map(",".join, zip(*cells, strict=True))))
    content = ("\n".join(parts) + "\n").encode()
    return write_atomic(
        path, gzip.compress(content, mtime=0) if str(path).endswith(".gz") else content
    )


def _cells(values: FloatArray) -> list[str]:
    """Shortest text that reads back as the same number; empty for NaN."""
    return ["" if v != v else repr(v) for v in values.tolist()]
