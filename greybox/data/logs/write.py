"""Writer of the flight-log contract: canonical channels as CSV, exact to the last digit."""

from __future__ import annotations

import gzip
import os
from pathlib import Path

import numpy as np

from greybox.data.raw import RawLog
from greybox.files import write_atomic


def write_csv(path: str | os.PathLike[str], raw: RawLog) -> Path:
    """Write the canonical channels of a log, rows in their order, missing values as empty cells; `.gz` compresses.

    Every number reads back as it is. Raises `OutputError`.
    """
    names = [*raw.channels]
    columns = [raw.t, *(raw.channels[n] for n in names)]
    lines = [",".join(["t", *names])]
    for row in zip(*columns, strict=True):
        lines.append(",".join("" if np.isnan(v) else repr(float(v)) for v in row))
    content = ("\n".join(lines) + "\n").encode()
    return write_atomic(path, gzip.compress(content, mtime=0) if str(path).endswith(".gz") else content)
