"""The pieces of the training flights that are left out: what models are chosen and, without test
flights, judged on."""

from __future__ import annotations

import numpy as np

from greybox.automatic.foretell import LEAST
from greybox.data import Dataset, Flight

FIRST_PART = 0.65
"""Share of a flight that sets are fitted to; the rest is foretold."""
ENOUGH_SECONDS = 150.0
"""Flight time from which more only costs time when sets are compared."""
ENOUGH_EACH = 15.0
"""Seconds of one flight that are enough: rather more flights than longer ones."""
SHORTEST = LEAST / (1.0 - FIRST_PART)
"""Flights shorter than this [s] are too short to leave a part out: it would judge without error."""


def first_parts(data: Dataset) -> tuple[Dataset, Dataset] | None:
    """(first parts, the rest) of enough flights; None where all flights are too short."""
    long = [f for f in data if f.duration >= SHORTEST]
    if not long:
        return None
    count = min(len(long), int(ENOUGH_SECONDS / ENOUGH_EACH))
    some = [long[i] for i in np.linspace(0, len(long) - 1, count).round().astype(int)]
    cut = tuple(_first_seconds(f, ENOUGH_SECONDS / len(some)) for f in some)
    return Dataset(flights=cut).split_by_time(FIRST_PART)


def _first_seconds(flight: Flight, seconds: float) -> Flight:
    begin = float(flight.segments[0].t[0])
    return flight.between(begin, begin + seconds) or flight
