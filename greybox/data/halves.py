"""Flights that teach and flights that judge: kept apart, or the halves of those there are."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from greybox.data.dataset import Dataset
from greybox.errors import DataError

APART = 0.5
"""Seconds between the halves of a single flight: what is remembered has faded."""

EITHER = "give every flight to one of the two"
Files = Collection[tuple[str, str]]


def demand_disjoint(train: Files, test: Files = ()) -> None:
    """Raise `DataError` for a flight that is in both, under whatever name, and for one that trains
    twice: it would count as two. Flights are (name, SHA-256 of the file, "" for none)."""
    known: dict[str, str] = {}
    for name, content in train:
        if content and content in known:
            raise DataError(
                f"flights {known[content]} and {name} are the same file", fix="give each log once"
            )
        known[content] = name
    contents = dict(train)
    for name, content in test:
        if content and content in known:
            other = known[content]
            copy = f" (byte for byte {other})" * (other != name)
            raise DataError(f"flight {name} is both train and test{copy}", fix=EITHER)
        if name in contents:
            if not content:
                raise DataError(f"flight {name} is both train and test", fix=EITHER)
            raise DataError(
                f"two files are called {name}: one to train, one to test",
                fix="rename one of them: a flight is known by the name of its file",
            )


def demand_apart(train: Dataset, test: Dataset) -> None:
    """Raise `DataError` for a flight that is in both, whatever its names."""
    taught = {f.sha256 for f in train if f.sha256}
    for f in test:
        if f.sha256 in taught or any(f is g for g in train):
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
