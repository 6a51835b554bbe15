"""Fingerprint: which samples a log holds, whatever its file, its stamps and its number format.

A row is what the gyro measured (else the accelerometer, attitude, place; of a log of something else
all columns). A coarse sensor has the same few rows in every flight, but not in the same order: a
run of rows is as long as it takes to have seen so many different ones. Of all runs those are kept
whose hash says so, the same ones in every copy and every part (winnowing: Schleimer, Wilkerson and
Aiken 2003, SIGMOD). A sensor that flickers between a few rows has no run, and tells nothing. Of a
long log fewer are kept, some of the same ones.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

ROWS = (("p", "q", "r"), ("ax", "ay", "az"), ("qw", "qx", "qy", "qz"), ("x", "y", "z"))
STEPS = (1e-4, 1e-3, 1e-4, 1e-4)
"""What copies of a log keep of them, in rad/s, m/s^2, 1 and m: finer digits do not count."""
DIGITS = 5
"""What copies keep of columns of which nothing is known."""
DIFFERENT = 8
"""Different rows of a run."""
ONE_OF = 64
"""One run of so many is kept (or of twice, four times as many)."""
MOST = 256
"""Runs that are kept of a log."""
FEW = 3
"""Runs that logs may share by chance."""
SHARE = 0.1
"""Share of the runs of the shorter log from which the two are of one flight."""
BASE = 0x9E3779B97F4A7C15
"""An odd number: powers of it tell the places in a run apart."""


class LogFile(NamedTuple):
    """What tells a log from others: the name of the flight, SHA-256 of the file ("" for none), and
    some of its samples."""

    name: str
    sha256: str = ""
    fingerprint: frozenset[str] = frozenset()


def fingerprint(channels: Mapping[str, npt.NDArray[np.float64]]) -> frozenset[str]:
    """Hashes (12 hex digits) of some runs of these channels (N,); empty where nothing was measured
    or too little changed. Digits below `STEPS` do not count: a copy with four decimals in rad/s, or
    three in deg/s, has the same ones or enough of them. Without any sensor of a vehicle all columns
    count, to `DIGITS`."""
    if not channels:
        return frozenset()
    rows = _rows(channels)
    hashes = np.zeros(len(rows), dtype=np.uint64)
    for column in rows.T:
        hashes = _mixed(hashes + column.view(np.uint64))
    ends = _ends(hashes)
    begins = np.arange(len(ends))
    sums = np.r_[np.zeros(1, np.uint64), np.cumsum(hashes * _powers(BASE, len(rows)))]
    back = _powers(pow(BASE, -1, 2**64), len(ends))
    runs = _mixed((sums[ends] - sums[begins]) * back)
    runs, one_of = np.unique(runs & np.uint64(2**48 - 1)), ONE_OF
    while len(kept := runs[runs % np.uint64(one_of) == 0]) > MOST:
        one_of *= 2
    return frozenset(f"{h:012x}" for h in kept.tolist())


def _rows(channels: Mapping[str, npt.NDArray[np.float64]]) -> npt.NDArray[np.float64]:
    """What copies of a log have in common, a row per sample (n, k)."""
    groups = zip(ROWS, STEPS, strict=True)
    names, step = next((g for g in groups if all(n in channels for n in g[0])), ((), 0.0))
    values = np.column_stack([channels[n] for n in names or sorted(channels)])
    values = values[np.isfinite(values).all(axis=1)]
    if not names:  # held ones count: how long a coarse reading stays is what tells two flights
        digit = 10.0 ** (np.floor(np.log10(np.maximum(np.abs(values), 1e-300))) - DIGITS + 1)
        return np.rint(values / digit) * digit + 0.0
    with np.errstate(over="ignore"):
        rows = np.rint(values / step) + 0.0  # no -0
    return rows[np.r_[True, (rows[1:] != rows[:-1]).any(axis=1)][: len(rows)]]  # held ones once


def of_one_flight(a: frozenset[str], b: frozenset[str]) -> bool:
    """Whether two logs (or a log and some others together), by their fingerprints, hold samples of
    the same flight."""
    common = [int(h, 16) for h in a & b]
    if len(common) <= FEW:
        return False
    bits = int(np.bitwise_or.reduce(common))
    one_of = bits & -bits  # of the log of which fewer are kept
    shorter = min(sum(int(h, 16) % one_of == 0 for h in log) for log in (a, b))
    return len(common) >= SHARE * shorter


def _ends(rows: npt.NDArray[np.uint64]) -> npt.NDArray[np.int64]:
    """Where the runs end (exclusive) that begin at row 0, 1, ...: as many as are whole."""
    names = rows.tolist()
    inside: dict[int, int] = {}
    ends, first = [], 0
    for last, name in enumerate(names):
        inside[name] = inside.get(name, 0) + 1
        while len(inside) == DIFFERENT:
            ends.append(last + 1)
            gone = names[first]
            inside[gone] -= 1
            if not inside[gone]:
                del inside[gone]
            first += 1
    return np.array(ends, dtype=np.int64)


def _mixed(x: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint64]:
    """Numbers in which every bit depends on all of these (splitmix64: Steele et al. 2014)."""
    x = x + np.uint64(BASE)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


def _powers(base: int, n: int) -> npt.NDArray[np.uint64]:
    """Powers 0 to n - 1, modulo 2^64."""
    return np.cumprod(np.r_[np.uint64(1), np.full(n, base, np.uint64)], dtype=np.uint64)[:n]
