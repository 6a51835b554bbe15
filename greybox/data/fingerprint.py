"""Fingerprint: which samples a log holds, whatever its file, its stamps and its number format.

A row of what the gyro measured (else the accelerometer, attitude, place) is its digits. Of all rows
those are kept whose hash says so, the same ones in every copy and in every part of a log: logs that
share more than a few share a flight (winnowing: Schleimer, Wilkerson and Aiken 2003, SIGMOD).
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

ROWS = (("p", "q", "r"), ("ax", "ay", "az"), ("qw", "qx", "qy", "qz"), ("x", "y", "z"))
DIGITS = 4
"""Significant digits that copies of a log keep."""
ONE_OF = 64
"""One row of so many is kept."""
FEW = 3
"""Rows that logs may share by chance: a still sensor repeats itself."""
SHARE = 0.1
"""Share of the rows of the shorter log from which the two are of one flight."""


class LogFile(NamedTuple):
    """What tells a log from others: the name of the flight, SHA-256 of the file ("" for none), and
    some of its samples."""

    name: str
    sha256: str = ""
    fingerprint: frozenset[str] = frozenset()


def fingerprint(channels: Mapping[str, npt.NDArray[np.float64]]) -> frozenset[str]:
    """Hashes of some rows of these channels (N,); empty where nothing was measured."""
    names = next((g for g in ROWS if all(n in channels for n in g)), ())
    if not names:
        return frozenset()
    rows = np.column_stack([channels[n] for n in names])
    rows = rows[np.isfinite(rows).all(axis=1)]
    form = ",".join([f"%.{DIGITS - 1}e"] * len(names))
    found = (hashlib.blake2b((form % tuple(r)).encode(), digest_size=6).digest() for r in rows)
    return frozenset(h.hex() for h in found if h[0] % ONE_OF == 0)


def of_one_flight(a: frozenset[str], b: frozenset[str]) -> bool:
    """Whether two logs, by their fingerprints, hold samples of the same flight."""
    common = len(a & b)
    return common > FEW and common >= SHARE * min(len(a), len(b))
