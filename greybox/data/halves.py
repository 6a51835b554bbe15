"""Flights that teach and flights that judge: kept apart, or the halves of those there are."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from greybox.data.dataset import Dataset
from greybox.data.fingerprint import LogFile, of_one_flight
from greybox.errors import DataError

APART = 0.5
"""Seconds between the halves of a single flight: what is remembered has faded."""

EITHER = "give every flight to one of the two"
COPY = "byte for byte"
Files = Collection[LogFile]


def demand_disjoint(train: Files, test: Files = ()) -> None:
    """Raise `DataError` for a flight that is in both, under whatever name, and for one that trains
    twice, as a copy or a part of another log: it would count as two."""
    known: list[LogFile] = []
    for one in (LogFile(*f) for f in train):
        if same := _alike(one, known):
            how = "are the same file" if same[1] == COPY else "hold the same samples"
            raise DataError(
                f"flights {same[0].name} and {one.name} {how}", fix="give each log once"
            )
        known.append(one)
    for one in (LogFile(*f) for f in test):
        name = one.name
        if same := _alike(one, known):
            copy = f" ({same[1]} {same[0].name})" * (same[0].name != name)
            raise DataError(f"flight {name} is both train and test{copy}", fix=EITHER)
        if any(name == k.name for k in known):
            if not one.sha256:
                raise DataError(f"flight {name} is both train and test", fix=EITHER)
            raise DataError(
                f"two files are called {name}: one to train, one to test",
                fix="rename one of them: a flight is known by the name of its file",
            )


def _alike(one: LogFile, known: Files) -> tuple[LogFile, str] | None:
    """The log among those `known` that a log is the same as, and how."""
    for other in known:
        if one.sha256 and one.sha256 == other.sha256:
            return other, COPY
        if of_one_flight(one.fingerprint, other.fingerprint):
            return other, "its samples are those of"
    return None


def demand_apart(train: Dataset, test: Dataset) -> None:
    """Raise `DataError` for a flight that is in both, whatever its names."""
    known = train.files
    for f, file in zip(test, test.files, strict=True):
        if _alike(file, known) or any(f is g for g in train):
            raise DataError(
                f"flight {f.name} is both train and test",
                expected="test flights that did not teach",
                fix=EITHER,
            )


def renamed(data: Dataset, taken: Sequence[str]) -> Dataset:
    """The flights under names that are not `taken`."""
    flights = []
    for f in data:
        name = f.name
        while name in taken:
            name = f"{name} (test)"
        flights.append(replace(f, name=name))
    return Dataset(flights=tuple(flights))


def halves(data: Dataset) -> tuple[Dataset, Dataset]:
    """Two sets of flights of about the same length; of one flight its two halves, apart."""
    if len(data.flights) > 1:
        sides: tuple[list[object], list[object]] = ([], [])
        length = [0.0, 0.0]
        for f in sorted(data, key=lambda f: -f.duration):
            i = int(length[1] < length[0])
            sides[i].append(f)
            length[i] += f.duration
        return tuple(Dataset(flights=tuple(s)) for s in sides)  # type: ignore[return-value, arg-type]
    (flight,) = data.flights
    t = np.concatenate([s.t for s in flight.segments])
    middle = t[t.size // 2]
    early, late = [], []
    for s in flight.segments:
        stop, start = np.searchsorted(s.t, [middle - APART / 2, middle + APART / 2])
        if stop > 1:
            early.append(s.rows(0, int(stop)))
        if s.n - start > 1:
            late.append(s.rows(int(start), s.n))
    return (
        Dataset(flights=(replace(flight, segments=tuple(early)),)),
        Dataset(flights=(replace(flight, name=f"{flight.name} (late)", segments=tuple(late)),)),
    )
