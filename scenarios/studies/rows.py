"""Results of long studies: one JSON line per row, kept as it comes, and the interval of a share."""

from __future__ import annotations

import argparse
import gzip
from pathlib import Path
from typing import Any

from scipy.stats import binomtest

from greybox.files import read_json_lines


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Rows of a file, none where it is not there; a line that was cut off counts as not there."""
    if not path.exists():
        return []
    return read_json_lines(
        gzip.decompress(path.read_bytes()).decode() if kept(path) else path.read_text()
    )


def kept(path: Path) -> bool:
    """Whether the file is compressed (.gz): results of a study that has ended, to which nothing is
    added."""
    return path.suffix == ".gz"


def open_ended(path: Path, parser: argparse.ArgumentParser) -> None:
    """Refuse, before anything is flown, to add to results that are kept."""
    if kept(path):
        parser.error(
            f"{path}: results that are kept can only be summed up; give --out another file to fly"
        )


def wilson(hits: int, total: int) -> tuple[float, float]:
    """95 % interval of a share (Wilson 1927, J. American Statistical Association 22); (0, 1) of
    none."""
    if not total:
        return 0.0, 1.0
    interval = binomtest(hits, total).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)
