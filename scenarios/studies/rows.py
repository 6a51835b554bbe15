"""Results of long studies: one JSON line per row, kept as it comes, and the interval of a share."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from scipy.stats import binomtest


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Rows of a file, none where it is not there; a line that was cut off counts as not there."""
    rows = []
    for line in path.read_text().splitlines() if path.exists() else ():
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError:
            continue
    return rows


def append_row(path: Path, row: dict[str, Any]) -> None:
    """One line, in one write, on the disk when this returns; a line that was cut off before it stays alone."""
    whole = not path.exists() or path.read_bytes()[-1:] in (b"", b"\n")
    with path.open("a") as stream:
        stream.write(("" if whole else "\n") + json.dumps(row) + "\n")
        stream.flush()
        os.fsync(stream.fileno())


def wilson(hits: int, total: int) -> tuple[float, float]:
    """95 % interval of a share (Wilson 1927, J. American Statistical Association 22); (0, 1) of none."""
    if not total:
        return 0.0, 1.0
    interval = binomtest(hits, total).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)
