"""Fingerprint: which samples a log holds, whatever its file, its stamps and its number format.

A row of what the gyro measured (else the accelerometer, attitude, place) is its digits. Of all rows
those are kept whose hash says so, the same ones in every copy and in every part of a log (winnowing:
Schleimer, Wilkerson and Aiken 2003, SIGMOD), each with its place. A coarse sensor has the same few
rows in every flight; in a copy and in a part they come in the same order, as far from each other.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

ROWS = (("p", "q", "r"), ("ax", "ay", "az"), ("qw", "qx", "qy", "qz"), ("x", "y", "z"))
DIGITS = 4
"""Significant digits that copies of a log keep."""
ONE_OF = 64
"""One row of so many is kept."""
MANY = 8
"""A row that one log has more often tells nothing."""
FEW = 3
"""Rows that logs may share by chance, the same way apart."""
SHARE = 0.1
"""Share of the rows of the shorter log from which the two are of one flight."""


class LogFile(NamedTuple):
    """What tells a log from others: the name of the flight, SHA-256 of the file ("" for none), and
    some of its samples."""

    name: str
    sha256: str = ""
    fingerprint: frozenset[str] = frozenset()


def fingerprint(channels: Mapping[str, npt.NDArray[np.float64]]) -> frozenset[str]:
    """Hashes of some rows of these channels (N,), each with its place ("hash:place"); empty where
    nothing was measured."""
    names = next((g for g in ROWS if all(n in channels for n in g)), ())
    if not names:
        return frozenset()
    rows = np.column_stack([channels[n] for n in names])
    rows = rows[np.isfinite(rows).all(axis=1)]
    rows = rows[np.r_[True, (rows[1:] != rows[:-1]).any(axis=1)][: len(rows)]]  # held ones once
    form = ",".join([f"%.{DIGITS - 1}e"] * len(names))
    hashes = (hashlib.blake2b((form % tuple(r)).encode(), digest_size=6).digest() for r in rows)
    kept = [(h.hex(), place) for place, h in enumerate(hashes) if h[0] % ONE_OF == 0]
    often = Counter(h for h, _ in kept)
    return frozenset(f"{h}:{place:x}" for h, place in kept if often[h] <= MANY)


def of_one_flight(a: frozenset[str], b: frozenset[str]) -> bool:
    """Whether two logs, by their fingerprints, hold samples of the same flight: the same rows, as
    far from each other."""
    here, there = _places(a), _places(b)
    ways = Counter(i - j for h in here.keys() & there.keys() for i in here[h] for j in there[h])
    common = max(ways.values(), default=0)
    return common > FEW and common >= SHARE * min(len(a), len(b))


def _places(rows: Iterable[str]) -> dict[str, list[int]]:
    found: dict[str, list[int]] = {}
    for row in rows:
        name, place = row.split(":")
        found.setdefault(name, []).append(int(place, 16))
    return found
